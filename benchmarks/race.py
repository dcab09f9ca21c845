"""A race against the strongest solvers at hand: `python benchmarks/race.py [--smoke]`. The page is docs/race.md.

The same problems, cold, for everybody, one core, CPU time, set-up excluded. Every rival is a process in an environment
apart (`--venvs`, folders made by `--install`); rivals that are not there are reported as missing. Objectives are
those of executing a rival's own actions in the LCS; the reference is the best of all, and our solver from 32
random starts. Written as JSON, from which the page's tables are rendered when the site is built.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
import tyro
from race_hard import measure, tune
from race_problems import RELAXATION, as_mpc, hard_cost, small, with_contact, without_contact
from rivals.problem import Problem

from difflcs.cli.bench import machine, save, smoke_path
from difflcs.mpc import kkt
from difflcs.mpc.backends import BatchedBackend, IpoptBackend
from difflcs.mpc.problem import MPCProblem
from difflcs.mpc.solution import Primal

HERE = Path(__file__).parent
EQUAL = 1e-3  # relative difference of objectives that counts as one


@dataclass(frozen=True)
class Entry:
    """A line of the tables.

    Attributes:
        label: its name there.
        module: file in `rivals/`.
        settings: arguments of its `Solver`.
        venv: the environment with its packages; "" for this one.
        packages: what `--install` puts there.
    """

    label: str
    module: str
    settings: dict[str, object] = field(default_factory=dict)
    venv: str = ""
    packages: tuple[str, ...] = ()


PLAIN = {"bound_relax_factor": 0.0}
TUNED = {"tol": 1e-6, "mu_init": 1e-4, "bound_relax_factor": 0.0}
TUNED |= {"fast_step_computation": "yes", "mumps_pivot_order": 0}
ADAPTIVE = {**TUNED, "mu_strategy": "adaptive"}
CONTACT = (
    Entry("difflcs `batched`", "layer"),
    Entry("difflcs `ipopt`", "layer", {"backend": "ipopt"}),
    Entry("IPOPT, λ = s = 1", "casadi_nlp", {"start": 1.0, "options": PLAIN}),
    Entry("IPOPT, tuned", "casadi_nlp", {"start": 0.1, "options": TUNED}),
    Entry("IPOPT, tuned, adaptive", "casadi_nlp", {"start": 0.1, "options": ADAPTIVE}),
    Entry("FATROP, λ = 1", "casadi_nlp", {"name": "fatrop", "start": 1.0}),
    Entry(
        "FATROP, tuned",
        "casadi_nlp",
        {"name": "fatrop", "start": 0.1, "options": {"tol": 1e-5, "mu_init": 1e-2, "max_iter": 1000}},
    ),
    Entry("Uno, interior point", "casadi_nlp", {"name": "uno", "start": 0.1, "options": {"preset": "ipopt"}}),
    Entry("Uno, SQP", "casadi_nlp", {"name": "uno", "start": 0.1, "options": {"preset": "filtersqp"}}),
    Entry("SLEQP", "casadi_nlp", {"name": "sleqp", "start": 0.1}),
)
LINEAR = (
    Entry("difflcs `batched`", "layer"),
    Entry("difflcs controller, cold", "layer", {"backend": "controller"}),
    Entry("DAQP", "daqp_qp", {}, "rivals", ("daqp",)),
    Entry("acados (HPIPM)", "acados_ocp", {}, "acados", ("comma-deps-acados", "numpy")),
    Entry("Clarabel", "clarabel_qp", {}, "rivals", ("clarabel", "scipy")),
    Entry("qpax", "qpax_qp", {}, "rivals", ("qpax",)),
    Entry("mpc.pytorch", "mpc_pytorch", {}, "mpc", ("torch==2.13.0", "mpc")),
    Entry("cvxpylayers", "cvxpylayers_qp"),
)


@dataclass
class Options:
    """The race."""

    problems: int = 5
    """Problems of an entry that are solved one by one."""
    batch: int = 256
    """Problems of an entry with contact that are solved in one call, by who can; without contact at most 32."""
    seeds: int = 3
    """Models, or seeds of initial states, of a family."""
    rounds: int = 2
    """How often everybody solves everything, taking turns; the shortest time of each problem counts."""
    seconds: float = 1.0
    """CPU seconds of a rival for an entry and round; after at least two problems it stops there."""
    venvs: Path = Path("/tmp/difflcs-race")
    """Folder of the rivals' environments."""
    install: bool = False
    """Make these environments, from the package index, and end."""
    parts: tuple[str, ...] = ("contact", "linear", "global", "planners")
    """Parts to run; the others stay as they are in the file."""
    only: tuple[str, ...] = ()
    """Labels of those who take part, but for the global optima; everybody if none is named."""
    tune: float = 0.0
    """CPU seconds in which settings of each planner are drawn for each family, on other seeds; then it ends."""
    out: Path = Path("benchmarks/results/race.json")
    """Path of the JSON output."""
    smoke: bool = False
    """Everything tiny, in a record of its own."""


# --- environments and processes ---------------------------------------------------------------------------------------


def install(venvs: Path) -> None:
    """Make an environment for each group of rivals whose packages agree; report and leave out failures."""
    wanted: dict[str, list[str]] = {}
    for entry in (*CONTACT, *LINEAR):
        wanted.setdefault(entry.venv, []).extend(entry.packages)
    for name, packages in wanted.items():
        if not name:
            continue
        python = venvs / name / "bin" / "python"
        subprocess.run([sys.executable, "-m", "venv", str(venvs / name)], check=True)
        for package in packages:
            done = subprocess.run([python, "-m", "pip", "install", "-q", package], check=False)
            print(f"{name}: {package} {'installed' if done.returncode == 0 else 'COULD NOT BE INSTALLED'}", flush=True)


class Process:
    """A rival that waits for jobs."""

    def __init__(self, entry: Entry, venvs: Path, folder: str):
        self.entry = entry
        python = str(venvs / entry.venv / "bin" / "python") if entry.venv else sys.executable
        one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS"), "1")
        flags = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
        self.missing, self.version = "", ""
        if entry.venv and not Path(python).exists():
            self.missing = f"no environment {entry.venv}; run with --install"
            return
        command = [python, "-P", str(HERE.resolve() / "rivals" / "run.py"), entry.module, json.dumps(entry.settings)]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
            env={**os.environ, **one, "XLA_FLAGS": flags}, cwd=folder,
        )  # fmt: skip
        hello = self._answer()
        self.version, self.missing = hello.get("version", ""), hello.get("missing", hello.get("error", ""))

    def _answer(self) -> dict:
        assert self.process.stdout
        line = self.process.stdout.readline()
        return json.loads(line) if line else {"error": f"the process ended with code {self.process.wait()}"}

    def ask(self, **job: object) -> dict:
        """Send a job; return its answer, with the arrays that the rival has written into the file `out`."""
        assert self.process.stdin
        if self.process.poll() is not None:
            return {"error": f"the process ended with code {self.process.returncode}"}
        self.process.stdin.write(json.dumps(job) + "\n")
        self.process.stdin.flush()
        answer = self._answer()
        if "error" not in answer:
            with np.load(str(job["out"])) as file:
                answer |= dict(file)
        return answer

    def close(self) -> None:
        """End the process."""
        if hasattr(self, "process"):
            self.process.communicate()


def start(entries: tuple[Entry, ...], venvs: Path, folder: str) -> list[Process]:
    """Start all rivals that are installed, and report the others."""
    processes = [Process(entry, venvs, folder) for entry in entries]
    for process in processes:
        print(f"  {process.entry.label:24s} {'MISSING: ' + process.missing if process.missing else process.version}")
    return processes


# --- judging ----------------------------------------------------------------------------------------------------------


@dataclass
class Judged:
    """Value of a rival's actions: objective of executing them, and whether they are a certified optimum to 0.1 %."""

    objective: np.ndarray
    solved: np.ndarray
    gradient_error: np.ndarray


def judge(problem: Problem, u: np.ndarray, said: np.ndarray, gradient: np.ndarray | None) -> Judged:
    """Execute the actions, polish them by Newton steps, certify, and compare gradients at this very optimum.

    A rival without gradients gets those of the optimality conditions at its unpolished plan.
    """
    mpc = as_mpc(problem, len(u))
    plan = mpc.clip(torch.from_numpy(np.nan_to_num(u)))
    x, lam = mpc.rollout(plan)
    raw = Primal(x, plan, lam, mpc.no_multipliers())
    exact = kkt.polish(mpc, raw)
    linear = kkt.linearise(mpc, exact)
    residual = kkt.residual(mpc, exact, linear.multipliers)
    objective, polished = mpc.objective(x, plan), mpc.objective(exact.x, exact.u)
    near = (objective - polished).abs() <= EQUAL * polished.abs()
    solved = torch.from_numpy(said) & (residual <= 1e-6) & near
    true = _sensitivity(mpc, linear, problem.weight)
    sensitivity = _sensitivity(mpc, kkt.linearise(mpc, raw), problem.weight)
    if gradient is not None:
        sensitivity = torch.from_numpy(gradient[: len(u)].copy())
    size = true.norm(dim=1)
    error = torch.where(solved & (size > 1e-9), (sensitivity - true).norm(dim=1) / size, torch.nan)
    return Judged(objective.numpy(), solved.numpy(), error.numpy())


def _sensitivity(mpc: MPCProblem, linear: kkt.Linearisation, weight: np.ndarray) -> torch.Tensor:
    zeros = (torch.zeros_like(v) for v in linear.primal[:3])
    x, u, lam = zeros
    u[:, 0] = torch.from_numpy(weight)
    every = torch.ones(mpc.batch, dtype=torch.bool)
    return kkt.vjp(mpc, linear, (x, u, lam, torch.zeros(mpc.batch, dtype=torch.float64)), every)["x0"]


# --- the race ---------------------------------------------------------------------------------------------------------


def run(problem: Problem, processes: list[Process], o: Options, folder: str) -> dict[str, dict]:
    """Run one entry: everybody solves it in turns, `rounds` times."""
    path, out = f"{folder}/{len(os.listdir(folder))}.npz", f"{folder}/answer.npz"  # rivals know a problem by its path
    problem.save(path)
    best: dict[str, dict] = {}
    for _ in range(o.rounds):
        for process in [p for p in processes if not p.missing]:
            label = process.entry.label
            if "error" in best.get(label, {}):
                continue
            answer = process.ask(problem=path, out=out, seconds=o.seconds, few=o.problems)
            if "error" in answer or label not in best:
                best[label] = answer
                continue
            old, n = best[label], min(len(best[label]["times"]), len(answer["times"]))
            old["times"] = [min(a, b) for a, b in zip(old["times"][:n], answer["times"], strict=False)]
            for name in ("batch", "with_gradient"):
                if name in answer:
                    old[name] = min(old[name], answer[name])
    constant = np.broadcast_to(problem.constant, problem.count)[: o.problems]
    reference = np.full(o.problems, np.inf)
    if problem.n_lam:
        mpc = as_mpc(problem, o.problems)
        ours = BatchedBackend(restarts=32, max_iter=600).solve(mpc, None)
        cost = mpc.objective(ours.primal.x, ours.primal.u)
        reference = torch.where(ours.solved, cost, torch.inf).numpy() + constant
    judged = {}
    for label, outcome in best.items():
        if "error" not in outcome:
            n = len(outcome["times"])
            judged[label] = judge(problem, outcome["u"][:n], np.array(outcome["solved"][:n]), outcome.get("gradient"))
            judged[label].objective += constant[:n]
            solved = np.where(judged[label].solved, judged[label].objective, np.inf)
            reference[:n] = np.minimum(reference[:n], solved)
    rows = {}
    for label, outcome in best.items():
        if "error" in outcome:
            rows[label] = {"error": outcome["error"]}
            continue
        j, n = judged[label], len(outcome["times"])
        gap = (j.objective - reference[:n]) / reference[:n]
        rows[label] = {
            "seconds": float(np.mean(outcome["times"])),
            "times": [float(t) for t in outcome["times"]],
            "solved": int(j.solved.sum()),
            "of": n,
            "gap": [float(v) for v in gap[j.solved]],
            "gradient error": [float(v) for v in j.gradient_error[np.isfinite(j.gradient_error)]],
        }
        for name in ("batch", "with_gradient"):
            if name in outcome:
                rows[label][name] = outcome[name] / problem.count
    return rows


def ratio(row: dict, ours: dict) -> float:
    """Time of a rival over ours, on the problems that it came to."""
    return sum(row["times"]) / sum(ours["times"][: len(row["times"])])


def summary(entries: list[dict[str, dict]]) -> dict[str, dict]:
    """Summarise a family: geometric mean and range over its entries of times and ratios, gap and share solved."""
    ours = [entry["difflcs `batched`"] for entry in entries]
    table = {}
    for label in entries[0]:
        rows = [entry[label] for entry in entries]
        errors = [row["error"] for row in rows if "error" in row]
        if errors:
            table[label] = {"error": errors[0]}
            continue
        one = np.array([ratio(row, mine) for row, mine in zip(rows, ours, strict=True)])
        in_batch = np.array([row["seconds"] / mine["batch"] for row, mine in zip(rows, ours, strict=True)])
        gaps = np.concatenate([row["gap"] for row in rows])
        errors = np.concatenate([row["gradient error"] for row in rows])
        table[label] = {
            "seconds": geometric([row["seconds"] for row in rows]),
            "ratio": [geometric(one), float(one.min()), float(one.max())],
            "ratio to batch": [geometric(in_batch), float(in_batch.min()), float(in_batch.max())],
            "solved": sum(row["solved"] for row in rows),
            "of": sum(row["of"] for row in rows),
            "mean gap": float(gaps.mean()) if len(gaps) else None,
            "near": float((gaps <= EQUAL).mean()) if len(gaps) else None,
            "gradient error": float(np.median(errors)) if len(errors) else None,
        }
        for name in ("batch", "with_gradient"):
            if name in rows[0]:
                table[label][name] = geometric([row[name] for row in rows])
    return table


def geometric(values: list[float] | np.ndarray) -> float:
    """Compute the geometric mean."""
    return float(np.exp(np.mean(np.log(np.maximum(values, 1e-9)))))


def best_rival(families: dict[str, dict]) -> dict[str, dict]:
    """Find for each family the fastest rival that solved everything, and its ratio to ours; their geometric mean."""
    fastest = {}
    for family, table in families.items():
        whole = {
            label: row
            for label, row in table.items()
            if not label.startswith("difflcs") and "error" not in row and row["solved"] == row["of"]
        }
        if whole:
            label = min(whole, key=lambda name: whole[name]["ratio"][0])
            fastest[family] = {"rival": label, "one": whole[label]["ratio"], "batch": whole[label]["ratio to batch"]}
    for kind in ("one", "batch"):
        values = [row[kind][0] for row in fastest.values() if isinstance(row, dict) and "rival" in row]
        if values:
            fastest[f"geometric mean, {kind}"] = {"ratio": geometric(values), "range": [min(values), max(values)]}
    return fastest


def race(name: str, o: Options) -> Iterator[tuple[str, object]]:
    """Run one part of the race; return its entries of the JSON."""
    entries = tuple(e for e in (CONTACT if name == "contact" else LINEAR) if not o.only or e.label in o.only)
    batch, make = (o.batch, with_contact) if name == "contact" else (min(o.batch, 32), without_contact)
    problems = make(max(batch, o.problems), o.seeds)
    with tempfile.TemporaryDirectory() as folder:
        processes = start(entries, o.venvs, folder)
        families = {}
        for family, members in problems.items():
            families[family] = summary([run(problem, processes, o, folder) for problem in members])
            for label, row in families[family].items():
                print(f"{family:20s} {label:24s} {row.get('error') or row['ratio'][0]}", flush=True)
        for process in processes:
            process.close()
    yield name, families
    yield f"{name}, best rival", best_rival(families)
    yield f"{name}, versions", {p.entry.label: p.version for p in processes if not p.missing}
    yield f"{name}, missing", {p.entry.label: p.missing for p in processes if p.missing}


def globally(o: Options) -> dict[str, dict]:
    """Compute for each small family the relative cost of our plans above the global optimum, with hard contact."""
    branch = Entry("branch and bound", "global_optimum", {"nodes": 300} if o.smoke else {}, "rivals", ("daqp",))
    backends = {
        "`batched`": (BatchedBackend(), RELAXATION),
        "`batched`, λ·s = 1e-7": (BatchedBackend(), 1e-7),
        "`batched`, λ·s = 1e-8": (BatchedBackend(), 1e-8),
        "`best`": (BatchedBackend(effort="best"), RELAXATION),
        "`ipopt`": (IpoptBackend(workers=1), RELAXATION),
    }
    families: dict[str, dict] = {}
    with tempfile.TemporaryDirectory() as folder:
        (process,) = start((branch,), o.venvs, folder)
        if process.missing:
            return {"missing": {"error": process.missing}}
        for family, problem in small(min(o.problems, 4), o.seeds):
            path = f"{folder}/{len(os.listdir(folder))}.npz"
            problem.save(path)
            answer = process.ask(problem=path, out=f"{folder}/answer.npz", few=problem.count, seconds=1e9)
            table = families.setdefault(family, {"problems": 0, "proved": 0, "seconds": [], "gaps": {}})
            if "error" in answer:
                families[family] = table = answer
            if "error" in table:  # of this seed, or of one before
                continue
            mpc, proved = as_mpc(problem), np.array(answer["solved"])
            best = hard_cost(mpc, torch.from_numpy(answer["u"]))[proved].numpy()
            table["problems"] += problem.count
            table["proved"] += int(proved.sum())
            table["seconds"] += answer["times"]
            for name, (backend, at) in backends.items():
                u = backend.solve(replace(mpc, relaxation=at), None).primal.u
                cost = hard_cost(mpc, mpc.clip(u))[proved].numpy()
                gap = (cost - best) / (best + np.broadcast_to(problem.constant, problem.count)[proved])
                table["gaps"].setdefault(name, []).extend(float(v) for v in gap)
        process.close()
    for family, table in families.items():
        if "error" in table:
            continue
        gaps = {name: np.array(values) for name, values in table["gaps"].items()}
        table["seconds"] = float(np.mean(table["seconds"]))
        table["gaps"] = {
            name: {"mean": float(v.mean()), "worst": float(v.max()), "within 0.1 %": float((v <= 1e-3).mean())}
            for name, v in gaps.items()
        }
        shown = "  ".join(
            f"{name} {100 * row['mean']:.3f} % (worst {100 * row['worst']:.2f})" for name, row in table["gaps"].items()
        )
        print(f"{family}: {table['proved']} of {table['problems']} proved, {table['seconds']:.2f} s each; {shown}")
    return families


def main(o: Options) -> None:
    """Run the race, print and write the figures."""
    if o.install:
        install(o.venvs)
        return
    if o.tune:
        tune(o.tune, o.only)
        return
    if o.smoke:
        o.problems, o.batch, o.seeds, o.rounds = 2, 3, 1, 1
        o.out = smoke_path(o.out)
    torch.set_num_threads(1)
    options = {name: getattr(o, name) for name in ("problems", "batch", "seeds", "rounds")}
    results = json.loads(o.out.read_text())["results"] if o.out.exists() else {}
    for name in o.parts:
        alone = {"global": globally, "planners": lambda o: measure(o.problems, o.seeds, o.rounds, o.only)}
        old = results.get(name, {})
        results |= {name: alone[name](o)} if name in alone else dict(race(name, o))
        if name == "planners" and o.only:  # the rows of the others stay
            new = {family: {k: rows[k] for k in o.only if k in rows} for family, rows in results[name].items()}
            results[name] = {**old, **{family: {**old.get(family, {}), **rows} for family, rows in new.items()}}
        save(o.out, {"machine": machine(), "options": options, "results": results})


if __name__ == "__main__":
    main(tyro.cli(Options))
