"""Tables of the documentation, from what the benchmarks wrote into benchmarks/results."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

RESULTS = Path(__file__).parents[1] / "benchmarks" / "results"
EXPERT = "trifinger_rl_example.example.TorchPushPolicy"
NOT_RUN = "This part of the race has not been run."


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Markdown."""
    head = list(head)
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def number(value: float) -> str:
    """Two digits, never in powers of ten."""
    return f"{value:.0f}" if value >= 9.95 else f"{value:.1f}" if value >= 0.995 else f"{value:.2g}"


def duration(seconds: float) -> str:
    """With its unit."""
    return f"{number(1e3 * seconds)} ms" if seconds >= 1e-3 else f"{number(1e6 * seconds)} µs"


def spread(values: list[float]) -> str:
    """Geometric mean and range of ratios."""
    mean, low, high = values
    return f"{number(mean)}× ({number(low)}–{number(high)})"


def percent(value: float | None) -> str:
    """Of a relative gap."""
    if value is None:
        return ""
    return f"{100 * value:.0f} %" if value >= 0.0995 else f"{100 * value:.2g} %" if abs(value) >= 5e-6 else "0 %"


def times(part: str) -> Callable[[dict], str]:
    """Solvers by families: time one by one as ratio to ours; in brackets how many problems were not solved."""

    def make(record: dict) -> str:
        families = record["results"].get(part)
        if not families:
            return NOT_RUN
        labels = next(iter(families.values()))
        rows = []
        for label in labels:
            cells = []
            for family in families.values():
                row = family[label]
                if "error" in row:
                    cells.append("failed")
                elif label == "difflcs `batched`":
                    cells.append(f"{duration(row['seconds'])}; {duration(row['batch'])} in a batch")
                else:
                    failed = row["of"] - row["solved"]
                    cells.append(spread(row["ratio"]) + (f" [{failed} of {row['of']} failed]" if failed else ""))
            rows.append([label, *cells])
        return table(["", *families], rows)

    return make


def optima(record: dict) -> str:
    """Solvers by families: mean gap to the best known objective, share within 0.1 % of it."""
    families = record["results"]["contact"]
    rows = []
    for label in next(iter(families.values())):
        cells = []
        for family in families.values():
            row = family[label]
            some = "error" not in row and row["solved"]
            cells.append(f"{percent(row['mean gap'])} ({100 * row['near']:.0f} %)" if some else "—")
        rows.append([label, *cells])
    return table(["", *families], rows)


def gradients(part: str) -> Callable[[dict], str]:
    """Solvers by families: median relative error of the gradient, and time of a plan with its gradient in a batch."""

    def make(record: dict) -> str:
        families = record["results"].get(part)
        if not families:
            return NOT_RUN
        rows = []
        for label in next(iter(families.values())):
            cells = []
            for family in families.values():
                row = family[label]
                error = row.get("gradient error")
                own = f", {duration(row['with_gradient'])}" if "with_gradient" in row else ""
                cells.append("—" if error is None else f"{error:.0e}{own}")
            rows.append([label, *cells])
        return table(["", *families], rows)

    return make


def best(part: str) -> Callable[[dict], str]:
    """For each family the fastest rival that solved everything."""

    def make(record: dict) -> str:
        found = record["results"][f"{part}, best rival"]
        rows = [
            [name, row["rival"], spread(row["one"]), spread(row["batch"])]
            for name, row in found.items()
            if "rival" in row
        ]
        mean = [found[f"geometric mean, {kind}"] for kind in ("one", "batch")]
        last = [f"**{number(v['ratio'])}×** ({number(v['range'][0])}–{number(v['range'][1])})" for v in mean]
        rows.append(["**geometric mean**", "", *last])
        return table(["problems", "fastest that solved all", "one problem a call", "ours in a batch"], rows)

    return make


def hard(record: dict) -> str:
    """Gap to the global optimum with hard contact."""
    families = {name: row for name, row in record["results"]["global"].items() if "error" not in row}
    if not families:
        return "The race was run without DAQP, which the branch and bound needs."
    names = list(next(iter(families.values()))["gaps"])
    rows = [
        [name, f"{row['proved']} of {row['problems']}", duration(row["seconds"])]
        + [f"{percent(row['gaps'][n]['mean'])} ({percent(row['gaps'][n]['worst'])})" for n in names]
        for name, row in families.items()
    ]
    return table(["problems", "proved", "time of the search", *names], rows)


def by_family(families: dict[str, dict], cell: Callable[[dict], str]) -> str:
    """Planners by families; — where one was not run."""
    rows = [
        [label, *(cell(row[label]) if label in row else "—" for row in families.values())]
        for label in next(iter(families.values()))
    ]
    return table(["", *families], rows)


def planners(record: dict) -> str:
    """Planners by families: time of a plan, and mean gap to the best plan of all under hard contact."""
    return by_family(record["results"]["planners"], lambda row: f"{duration(row['seconds'])}, {percent(row['gap'])}")


def in_mujoco(record: dict) -> str:
    """Planners by tasks in MuJoCo: success with its interval, cost, and CPU time of a decision in the solver."""
    tasks, names = record["results"], {"cube": "cube", "box": "box to poses", "hand": "cube in the hand"}

    def cell(row: dict | None) -> str:
        if row is None:
            return "—"
        low, high = (f"{100 * v:.0f}" for v in row["interval"])
        new = f"{number(row['prepare_ms'])} + " if row["prepare_ms"] > 0.05 * row["solve_ms"] else ""
        return (
            f"{100 * row['success']:.0f} % ({low}–{high}) of {row['episodes']}; {row['cost']:.2f} ± "
            f"{row['cost_half']:.2f}; {new}{number(row['solve_ms'])} ms"
        )

    labels = dict.fromkeys(label for rows in tasks.values() for label in rows)
    rows = [[label, *(cell(tasks[name].get(label)) for name in names)] for label in labels]
    rest = [f"{number(tasks[name]['difflcs']['all_ms'] - tasks[name]['difflcs']['solve_ms'])} ms" for name in names]
    return table(["", *names.values()], [*rows, ["*all else of a decision*", *rest]])


def loops(record: dict) -> str:
    """Planners by families with closed loops: time of a step, and the cost in parts of ours."""
    families = {name: row for name, row in record["results"]["planners"].items() if "step" in row["difflcs"]}
    return by_family(families, lambda row: f"{duration(row['step'])}, {row['cost']:.2f}")


def versions(record: dict) -> str:
    """Who took part, and who did not."""
    lines, found = [], record["results"]
    for part in ("contact", "linear"):
        lines += [f"- {label}: {version}" for label, version in found.get(f"{part}, versions", {}).items()]
        lines += [f"- {label}: missing ({why})" for label, why in found.get(f"{part}, missing", {}).items()]
    return "\n".join(dict.fromkeys(lines))


def machine(record: dict) -> str:
    """Where and how much."""
    at, o = record["machine"], record["options"]
    return (
        f"Measured on {at['cpu']}, instruction set {at['instruction set']}: {o['seeds']} models or seeds of a family, "
        f"{o['problems']} problems of each one by one and {o['batch']} in a call, the best of {o['rounds']} rounds."
    )


def processor(record: dict) -> str:
    """What the times of a record were measured on."""
    at = record["machine"]
    return f"Times are of one core of an {at['cpu']} with the instruction set {at['instruction set']}."


def efforts(record: dict) -> str:
    """Optima that each effort of the batched backend reaches: mean and worst gap, share within 0.1 %, relative time."""
    names = ("fast", "default", "best")
    rows = [
        [f"{kind} ({row['problems']})"]
        + [
            f"{percent(row[e]['mean gap'])}, {percent(row[e]['worst gap'])} "
            f"({100 * row[e]['within 0.1 % of best']:.0f} %), "
            f"{row[e]['time alone']:.1f}×, {row[e]['time']:.1f}×"
            for e in names
        ]
        for kind, row in record["results"].items()
    ]
    return table(["problems", *(f'`"{name}"`' for name in names)], rows)


def sizes(record: dict) -> str:
    """Share of problems solved, and iterations of one start times the number of starts, by size and horizon."""
    shown = [row for row in record["rows"] if not row["family"].endswith("weak")]
    horizons = sorted({row["horizon"] for row in shown})
    found: dict[str, dict[int, str]] = {}
    for row in shown:
        label = f"{row['family']}, n_x {row['n_x']}, n_lam {row['n_lam']}"
        cell = f"{100 * row['solved']:.0f} %, {row['iterations']:.0f} × {row['starts']}"
        found.setdefault(label, {})[row["horizon"]] = cell
    rows = [[label, *(cells.get(h, "") for h in horizons)] for label, cells in found.items()]
    return table(["problems", *(f"H {h}" for h in horizons)], rows)


def weak(record: dict) -> str:
    """Share of problems solved where actions are weak, by horizon, of each backend."""
    shown = [row for row in record["rows"] if row["family"].endswith("weak")]
    horizons = sorted({row["horizon"] for row in shown})
    found: dict[str, list[str]] = {}
    for row in shown:
        label = f"{row['family'].split(',')[0]} models, `{row['backend']}`"
        found.setdefault(label, []).append(f"{100 * row['solved']:.1f} %")
    return table(["problems", *(f"H {h}" for h in horizons)], [[label, *cells] for label, cells in found.items()])


def recipes(record: dict) -> str:
    """Success at each of the minutes, and seconds of one core: mean and range over seeds, and differences by seed."""
    rows = sorted(record["rows"], key=lambda row: row["seed"])
    minutes = sorted({row["minutes"] for row in rows})

    def column(method: str, name: str, at: float) -> np.ndarray:
        return np.array([row[name] for row in rows if (row["method"], row["minutes"]) == (method, at)])

    def cell(values: np.ndarray, unit: str, digits: int = 1, sign: str = "") -> str:
        mean, low, high = (f"{v:{sign}.{digits}f}" for v in (values.mean(), values.min(), values.max()))
        return f"{mean} {unit} ({low} to {high})".replace("-", "−")

    found = []
    for method, label in (("lcs-rl", "default"), ("quick", "quick")):
        success = [cell(100 * column(method, "success_rate", at), "%") for at in minutes]
        found.append([label, *success, cell(column(method, "training_cpu_seconds", minutes[-1]), "s", 0)])
    change = [column("lcs-rl", "success_rate", at) - column("quick", "success_rate", at) for at in minutes]
    found.append(["default − quick", *(cell(100 * c, "points", sign="+") for c in change), ""])
    return table(["settings", *(f"{m:g} min of data" for m in minutes), "computing"], found)


WAYS = {
    "kernel": "the kernel alone",
    "controller": "controller",
    "layer": "layer, no gradient",
    "layer and gradient": "layer and gradient",
}


def latency(record: dict) -> str:
    """Median and 99th percentile of a call, and the median as a multiple of the kernel's."""
    robots = record["results"]
    rows = []
    for way, label in WAYS.items():
        cells = []
        for robot in robots.values():
            row = robot[way]
            ratio = "" if way == "kernel" else f", {number(row['p50 to kernel'])}×"
            cells.append(f"{row['p50 µs']:.0f} / {row['p99 µs']:.0f} µs{ratio}")
        rows.append([label, *cells])
    return table(["", *robots], rows)


def deadlines(record: dict) -> str:
    """Squared errors of a closed loop with a deadline, and the share of steps that were not solved."""
    rows = []
    for limit, label in (("None", "none"), ("0.0002", "200 µs"), ("0.0001", "100 µs")):
        found = [record["deadline"][f"{on_failure} {limit}"] for on_failure in ("hold", "unfinished")]
        rows.append([label, *(f"{row['error']:.0f} ({100 * row['unsolved']:.0f} %)" for row in found)])
    return table(["deadline of a step", '`"hold"`', '`"unfinished"`'], rows)


DECIDES = {
    "PDDM": "PDDM, 700 sequences in three networks",
    "layer, cold": "LCS-MPC, `LCSMPCLayer`, cold",
    "controller": "LCS-MPC, [`layer.controller()`](robot.md), warm",
}


def decision(record: dict) -> str:
    """Milliseconds of one decision on the cube, and those of PDDM as a multiple."""
    spent = {way: row["p50 µs"] for way, row in record["results"]["zoo cube, H 8"].items() if way in DECIDES}
    rows = [[label, f"{1e-3 * spent[k]:.2g} ms", f"{spent['PDDM'] / spent[k]:.0f}×"] for k, label in DECIDES.items()]
    return table(["one decision", "computing", "PDDM takes"], rows)


STEPS = {"free": ("free", ""), "contact": ("contact", ""), "limit": ("limit", ""), "limit, near": ("limit", "near_")}


def told(errors: dict, way: str) -> str:
    """Error of a step, and in brackets that of differences; linearised at the usual nominal control or `near_`."""
    return f"{errors[way + 'lcs']:.2f} ({errors[way + 'fd']:.2f})"


def foreign(record: dict) -> str:
    """Models by others: errors of a step and those of differences in brackets, by kind; a refusal in words."""
    rows = []
    for name, row in record["results"].items():
        cells = ["", "", "", ""]
        if "refused" not in row:
            cells = [told(row[kind], way) if row[kind]["states"] else "" for kind, way in STEPS.values()]
        time = duration(1e-3 * row["ms"]) if "ms" in row else row["refused"].replace("|", "\\|")
        rows.append([name.replace("_", "\\_"), *cells, time])
    return table(["model", *STEPS, "time of a state, or why it is refused"], rows)


def summary(record: dict) -> str:
    """Models by others: how many of a package are accepted, and medians over these of the medians of a model."""
    rows, results = [], record["results"]
    for package in (*dict.fromkeys(name.split("/")[0] for name in results), ""):
        some = [row for name, row in results.items() if package in ("", name.split("/")[0])]
        accepted = [row for row in some if "refused" not in row]
        cells = [package.replace("_", "\\_") or "all", f"{len(accepted)} of {len(some)}"]
        for kind, way in STEPS.values():
            few = [row[kind] for row in accepted if row[kind]["states"] >= 5]
            medians = {of: np.median([v[of] for v in few]) for of in (f"{way}lcs", f"{way}fd") if few}
            cells.append(told(medians, way) if few else "")
        rows.append([*cells, duration(1e-3 * float(np.median([row["ms"] for row in accepted])))])
    return table(["package", "accepted", *STEPS, "time of a state"], rows)


def success(record: dict) -> str:
    """Success rate of a closed loop, its steps and time."""
    row = record["results"]
    interval = f"{100 * row['ci_low']:.1f} to {100 * row['ci_high']:.1f} %"
    cells = [f"{100 * row['success_rate']:.1f} %", interval, f"{row['goals']}", f"{row['mean_steps']:.0f}"]
    head = ["success", "95 % interval", "goals", "steps on average", "time of a decision"]
    return table(head, [[*cells, duration(1e-3 * row["milliseconds_per_step"])]])


def objects(record: dict) -> str:
    """Success on the objects: of one training over minutes of data, and of all seeds at the end."""
    told = [row for row in record["rows"] if row["method"] == "contact-lcs"]
    few = [row for row in told if row["seed"] == 0 and row["goals"] == 250]
    many = [row for row in told if row["goals"] == 1000 and row["minutes"] == row["total_minutes"] == 3]
    minutes = sorted({row["minutes"] for row in few})
    tasks = list(dict.fromkeys(row["task"] for row in few))
    rows = []
    for task in tasks:
        one = {row["minutes"]: f"{100 * row['success_rate']:.1f} %" for row in few if row["task"] == task}
        found = [100 * row["success_rate"] for row in many if row["task"] == task]
        mean = f"{sum(found) / len(found):.1f} % ({min(found):.1f} to {max(found):.1f})" if found else ""
        rows.append([task.replace("_", " "), *(one.get(m, "") for m in minutes), mean, f"{len(found)}"])
    head = ["", *(f"{m:g} min" for m in minutes), "3 min, all seeds: mean and range", "seeds"]
    return table(head, rows)


METHODS = {"contact-lcs": "ContactLCS", "frame-lcs": "LCS in the body's frame", "lcs-rl": "LCS-RL", "pddm": "PDDM"}


def largest(record: dict, task: str, method: str) -> list[dict]:
    """The evaluations of a method on an object that have the most goals."""
    own = [row for row in record["rows"] if (row["task"], row["method"]) == (task, method)]
    goals = max((row["goals"] for row in own), default=0)
    return [row for row in own if row["goals"] == goals]


def methods(record: dict) -> str:
    """Success over minutes of data on the cube: mean over the seeds, and the least."""
    minutes = sorted({row["minutes"] for row in record["rows"] if row["task"] == "cube"})
    rows = []
    for method, label in METHODS.items():
        own, cells, seeds = largest(record, "cube", method), [], set()
        for minute in minutes:
            rates = {row["seed"]: 100 * row["success_rate"] for row in own if row["minutes"] == minute}
            cells.append(f"{sum(rates.values()) / len(rates):.1f} ({min(rates.values()):.1f})" if rates else "")
            seeds |= {len(rates)} - {0}
        if own:
            count = " or ".join(map(str, sorted(seeds)))
            rows.append([label, own[0]["told"].split(" of ")[0], *cells, f"{count} × {own[0]['goals']}"])
    return table(["", "told", *(f"{m:g} min" for m in minutes), "seeds × goals"], rows)


VARIANTS = {
    "known": "physics as it is",
    "learned": "physics learned from 2 minutes of random pushing",
    "noise 2 px": "known; observed with a noise of 2 px",
    "one step late": "known; actions one step (0.1 s) late, predicted",
    "inertia -20 %": "inertia 20 % too small",
    "inertia +20 %": "inertia 20 % too large",
    "centre of mass": "centre of mass 12 px off",
    "friction 0.2": "friction 0.2 where there is none",
    "outline +10 %": "outline 10 % too large",
    "outline +20 %": "outline 20 % too large",
    "outline -10 %": "outline 10 % too small",
    "outline -20 %": "outline 20 % too small",
}


def pusht(record: dict) -> str:
    """Push-T by what the policy was told."""
    rows = []
    for name, label in VARIANTS.items():
        row = record["results"].get(name)
        if row is None:
            continue
        rows.append(
            [
                label,
                f"{100 * row['success_rate']:.1f} % ({100 * row['ci_low']:.1f} to {100 * row['ci_high']:.1f})",
                f"{row['episodes']}",
                f"{row['mean_steps']:.0f}",
                f"{row['coverage']:.3f}",
                f"{row['milliseconds_per_step']:.1f} ms",
            ]
        )
    return table(["the policy is told", "success", "episodes", "steps", "best overlap", "time of a step"], rows)


def published(record: dict) -> str:
    """What others and we report on Push-T, and what each was given."""
    ours = record["results"]["known"]
    rows = [
        ["Diffusion Policy, LeRobot", "pictures, place of the disc; 206 demonstrations", "63.8 %", "500", "0.959"],
        ["Diffusion Policy, its authors' code", "the same", "64.2 %", "500", "0.957"],
        [
            "difflcs, physics known",
            "state, shape, inertia, drive; no demonstration",
            f"{100 * ours['success_rate']:.1f} %",
            f"{ours['episodes']}",
            f"{ours['coverage']:.3f}",
        ],
    ]
    return table(["policy", "given", "success", "episodes", "best overlap"], rows)


RACE: dict[str, Callable[[dict], str]] = {
    "times": times("contact"),
    "optima": optima,
    "gradients": gradients("contact"),
    "best": best("contact"),
    "linear": times("linear"),
    "linear-gradients": gradients("linear"),
    "global": hard,
    "versions": versions,
    "machine": machine,
}

JUDO = {"contact-mpc": "contact MPC", "cem": "CEM", "mppi": "MPPI", "ps": "predictive sampling"}


def interval(row: dict) -> str:
    """Success rate and its interval of 95 %."""
    return f"{100 * row['success_rate']:.1f} % ({100 * row['ci_low']:.1f} to {100 * row['ci_high']:.1f})"


def cylinder(record: dict) -> str:
    """Judo's cylinder_push: ours and Judo's planners."""
    rows = []
    for name, row in record["results"].items():
        planner, _, rollouts = name.partition(", ")
        label = JUDO[planner] + (f", {rollouts}" if rollouts else "")
        away = f"{row['median_cm']:.2f} cm, {row['worst_cm']:.2f} cm"
        cpu = f"{row['cpu_ms_per_second']:.0f} ms, {row['machine']['instruction set'].upper()}"
        rows.append([label, interval(row), f"{row['episodes']}", away, cpu])
    head = ["planner", "within 2 cm", "episodes", "end, median and worst", "CPU time for a second"]
    return table(head, rows)


def scoreboards(record: dict) -> str:
    """All that others set and of which a record is kept; rows of others are written by hand in the page."""
    results = {
        name: json.loads((RESULTS / f"{name}.json").read_text())["results"] for name in ("inhand", "trifinger_rl")
    }
    push, hand = record["results"]["known"], results["inhand"]["all"]
    expert, ours = (results["trifinger_rl"][name] for name in (EXPERT, "contact-mpc"))
    rows = [
        [
            "[Push-T](planning.md#push-t)",
            interval(push),
            f"{push['episodes']}",
            "64.2 %, Diffusion Policy, from pictures",
        ],
        ["[in the hand](scoreboard_inhand.md)", interval(hand), f"{hand['episodes']}", "155 of 170 (91.2 %), IMPACT"],
        [
            "[trifinger-rl push](scoreboard_trifinger.md)",
            interval(ours),
            f"{ours['episodes']}",
            f"{interval(expert)}, the authors' expert, measured here",
        ],
    ]
    return table(["benchmark", "success", "episodes", "published, or of others"], rows)


# Record → part → table.
TABLES: dict[str, dict[str, Callable[[dict], str]]] = {
    "race": RACE,
    "race_avx512": {"best": best("contact")},
    "race_planners": {"plans": planners, "loops": loops},
    "race_loops": {"tasks": in_mujoco},
    "optima": {"efforts": efforts},
    "scale": {"sizes": sizes, "weak": weak},
    "training_time": {"recipes": recipes},
    "latency": {"ways": latency, "deadlines": deadlines, "decision": decision, "processor": processor},
    "objects": {"success": objects, "methods": methods},
    "physics_models": {"summary": summary, "models": foreign, "processor": processor},
    "box_to_pose": {"success": success, "processor": processor},
    "pusht": {"variants": pusht, "published": published, "scoreboards": scoreboards},
    "cylinder_push": {"planners": cylinder},
}
