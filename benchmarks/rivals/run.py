"""A rival as a process: reads a job in JSON from each line of its input, answers with a line of JSON.

Started by `race.py` in the environment that has the rival's packages: `python -P run.py RIVAL '{"setting": …}'`.
"""

import importlib
import importlib.util
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent


def package() -> None:
    """Make `rivals` importable without its neighbours: they would hide other packages."""
    spec = importlib.util.spec_from_file_location(
        "rivals", HERE / "__init__.py", submodule_search_locations=[str(HERE)]
    )
    assert spec
    assert spec.loader
    sys.modules["rivals"] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)


def cpu(work: Callable[..., Any], *given: Any) -> tuple[float, Any]:
    """Do some work; return CPU seconds of all threads, and its result."""
    start = time.process_time()
    result = work(*given)
    return time.process_time() - start, result


def race(name: str, settings: dict, job: dict) -> dict:
    """Solve the first `few` problems of a file one by one for `seconds`; then all in one call, if possible."""
    import numpy as np

    from rivals.problem import Problem

    module = importlib.import_module(f"rivals.{name}")
    problem = Problem.load(job["problem"])
    key = json.dumps([job["problem"], settings])
    if key not in KEPT:
        KEPT.clear()
        rival = module.Solver(problem, **settings)
        if rival.batches:
            rival.all()
        if rival.differentiates:
            rival.gradient()
        rival.one(0)
        KEPT[key] = rival
    rival = KEPT[key]
    began = time.process_time()
    plans, solved, times = [], [], []
    for i in range(min(problem.count, job["few"])):
        if i >= 2 and time.process_time() - began > job["seconds"]:
            break
        seconds, answer = cpu(rival.one, i)
        plans.append(answer.u[0])
        solved.append(bool(answer.solved[0]))
        times.append(seconds)
    out = {"u": np.array(plans)}
    report = {"times": times, "solved": solved}
    if rival.batches:
        report["batch"], _ = cpu(rival.all)
    if rival.differentiates:
        report["with_gradient"], answer = cpu(rival.gradient)
        out["gradient"] = answer.gradient
    np.savez(job["out"], **out)
    return report


KEPT: dict = {}


def main() -> None:
    """Serve jobs; the output of libraries is discarded."""
    reply = os.fdopen(os.dup(1), "w")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    package()
    name, settings = sys.argv[1], json.loads(sys.argv[2])
    try:
        module = importlib.import_module(f"rivals.{name}")
        hello = {"version": module.Solver.version()}
    except Exception as error:  # a rival that is not here is reported, whatever it lacks
        hello = {"missing": f"{type(error).__name__}: {error}"[:200]}
    print(json.dumps(hello), file=reply, flush=True)
    for line in sys.stdin:
        try:
            answer = race(name, settings, json.loads(line))
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"[:300]}
        print(json.dumps(answer), file=reply, flush=True)


if __name__ == "__main__":
    main()
