"""Figures of a run: its learning curve, the fit and the contacts of its model, and a video of its policy."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch

from difflcs._optional import require
from difflcs._storage import place_to_write, write_atomically
from difflcs.errors import DiffLCSError, InvalidInputError
from difflcs.fit import Transitions, fit_report
from difflcs.mpc import LCSMPCLayer
from difflcs.mpc.solution import draw_trajectory
from difflcs.records import LCSParams, LCSSequence, advance, system_at
from difflcs.rl.rollout import CONTEXT, Policy, collect, mpc_actions
from difflcs.rl.seeding import Stream, episode_seeds

if TYPE_CHECKING:
    import gymnasium
    from matplotlib.figure import Figure

    from difflcs.rl.tasks import TaskSpec

# Okabe–Ito colours, distinguishable by colour-blind readers.
_BLUE, _ORANGE, _GREY = "#0072b2", "#d55e00", "#999999"
_ROLLING = 8
"""Iterations averaged for the success of training episodes: 40 episodes."""


def plot_learning_curve(rows: Sequence[Mapping[str, str]], path: Path, title: str) -> None:
    """Success and loss against minutes of data, as a PNG.

    Args:
        rows: log.csv of a run, as `RunDirectory.rows()` returns it.
        path: where to write.
        title: above the figure.
    """
    require("matplotlib")
    from matplotlib.ticker import NullFormatter

    from difflcs._figure import page_figure

    with page_figure() as figure:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        figure.suptitle(title)

        x, success = _column(rows, "minutes", "success")
        rolling = [success[max(0, i + 1 - _ROLLING) : i + 1].mean() for i in range(len(success))]
        above.plot(x, 100 * np.array(rolling), color=_GREY, lw=1.5, label="episodes of the training")
        names = (f"evaluation_{name}" for name in ("success_rate", "ci_low", "ci_high", "goals"))
        x, rate, low, high, goals = _column(rows, "minutes", *names)
        if len(x):
            spread = 100 * np.stack([rate - low, high - rate])
            counts = f"{goals.min():.0f}" + (f" to {goals.max():.0f}" if goals.max() > goals.min() else "")
            style = {"color": _BLUE, "marker": "o", "lw": 2, "capsize": 4}
            above.errorbar(x, 100 * rate, spread, **style, label=f"evaluation on {counts} goals, 95 %")
            for at, value, top in zip(x, rate, high, strict=True):
                place = {"xytext": (0, 4), "textcoords": "offset points", "ha": "center", "va": "bottom"}
                above.annotate(f"{100 * value:.0f} %", (at, 100 * top), **place, fontsize=10, color=_BLUE)
        above.set(ylabel="success [%]", ylim=(0, 112), yticks=range(0, 101, 20))
        above.legend(frameon=False)

        lines = {"loss": (_ORANGE, "training"), "held_out_loss": (_BLUE, "held out")}
        fitted = [row for row in rows if row.get("loss")]
        for name, (color, label) in lines.items() if fitted else [("mean_return", (_ORANGE, "return"))]:
            x, values = _column(rows, "minutes", name)
            below.plot(x, values, color=color, lw=1.5, label=label)
        below.set(xlabel="data [min]", ylabel="loss of the fit" if fitted else "return of an episode")
        if fitted:
            below.set_yscale("log")
            low, high = np.log10(below.get_ylim())
            below.set_ylim(10 ** np.floor(low), 10 ** np.ceil(high))  # whole decades, or the axis has one number
            below.yaxis.set_minor_formatter(NullFormatter())
            below.legend(frameon=False)
        begun, _ = _column(rows, "minutes", "kl")
        if fitted and len(begun):
            for axes in (above, below):
                axes.axvline(float(fitted[-1]["minutes"]), color=_GREY, ls="--")
            text = {"xytext": (6, -6), "textcoords": "offset points", "va": "top", "color": "dimgrey"}
            below.annotate("from here on PPO", (float(fitted[-1]["minutes"]), 10 ** np.ceil(high)), **text)
        for axes in (above, below):
            axes.grid(alpha=0.25)
            axes.spines[["top", "right"]].set_visible(False)
    _write(figure, path)


def draw_policy(policy: Policy, task: TaskSpec, folder: Path, episodes: int = 20, seed: int = 0) -> list[Path]:
    """Play noise-free episodes, and draw how well the model predicts them and the contacts in the first of them.

    Args:
        policy: of a task; nothing is drawn of one that plans without an LCS.
        task: the task.
        folder: where fit.png and episode.png are written, or replaced.
        episodes: how many are played; the fit is judged on half of them, and an affine system learns from the others.
        seed: of goals and initial states, as of an evaluation.

    Returns:
        Paths of the pictures.
    """
    if not isinstance(policy, LCSMPCLayer) or isinstance(policy.lcs, LCSSequence):
        return []
    with closing(task.make_envs(episodes)) as envs:
        seeds = episode_seeds(seed, Stream.EVALUATION, 0, episodes)
        played = collect(envs, mpc_actions(policy), seeds, task.episode_steps)
    data = Transitions.from_episodes(played["state"], played["action"])
    context = played[CONTEXT].repeat_interleave(task.episode_steps, 0) if CONTEXT in played.keys() else None
    judged = (episodes + 1) // 2 * task.episode_steps  # the affine system beside the model is fitted to the others
    train = [value[judged:] for value in data] if episodes > 1 else None
    here = None if context is None else context[:judged]
    report = fit_report(policy.lcs, *(value[:judged] for value in data), train=train, context=here)
    _write(report.plot(), folder / "fit.png")

    first = slice(task.episode_steps)
    x, u, at = data.x[first], data.u[first], None if context is None else context[first]
    with torch.no_grad():
        system = policy.lcs if isinstance(policy.lcs, LCSParams) else system_at(policy.lcs, x, at)
        assert isinstance(system, LCSParams)  # or there was no report
        lam = advance(system, x, u).lam
        gap, bounds = system.gap(x, u, lam), [bound.expand(u.shape) for bound in policy.limits()]
    errors = (f"{e.name.replace('_', ' ')} {float(played['errors', e.name][0]):.3g} {e.unit}" for e in task.errors)
    title = f"{'reached' if played['success'][0] else 'missed'}; {', '.join(errors)}"
    _write(draw_trajectory(played["state"][0], u, lam, gap, bounds, title), folder / "episode.png")
    return [folder / "fit.png", folder / "episode.png"]


def _write(figure: Figure, path: Path) -> None:
    from difflcs._figure import to_png

    with place_to_write(path):
        write_atomically(path, to_png(figure))


def _column(rows: Sequence[Mapping[str, str]], *names: str) -> tuple[np.ndarray, ...]:
    """Columns as arrays, of the rows that have a value in each of them."""
    values = np.array([[float(row[n]) for n in names] for row in rows if all(row.get(n) for n in names)])
    return tuple(values.reshape(-1, len(names)).T)


class NoPictureError(DiffLCSError):
    """This machine cannot draw the environment."""


def record_video(
    env: gymnasium.Env[Any, Any],
    policy: Policy,
    goals: Sequence[Sequence[float]],
    path: Path,
    task: TaskSpec,
    seed: int = 0,
) -> list[bool]:
    """Play one noise-free episode per goal into an MP4 or GIF, in real time, with the task's caption above.

    Args:
        env: one environment of the task with render_mode="rgb_array".
        policy: the policy to play.
        goals: goals, played one after another.
        path: where to write; replaced atomically.
        task: the task.
        seed: of the initial states.

    Returns:
        For each goal, True if it was reached.

    Raises:
        InvalidInputError: a goal is outside the goal space.
        NoPictureError: the environment cannot be drawn here.
    """
    require("imageio", "imageio_ffmpeg", "PIL")
    import imageio.v2 as imageio

    space = env.observation_space["goal"]  # pyright: ignore[reportIndexIssue]
    chosen = [np.asarray(goal, space.dtype) for goal in goals]
    for goal in chosen:
        if not space.contains(goal):
            low, high = space.low.tolist(), space.high.tolist()
            raise InvalidInputError(f"goal: expected {low} <= goal <= {high}, got {goal.tolist()}")
    path.parent.mkdir(parents=True, exist_ok=True)
    kind, seconds = path.suffix.lower(), task.step_seconds
    gif = {"duration": 1000 * seconds, "loop": 0, "format": "GIF"}
    options = gif if kind == ".gif" else {"fps": max(1, round(1 / seconds)), "quality": 8}
    temporary = path.with_name(f".{path.stem}.tmp{kind}")
    target = io.BytesIO() if kind == ".gif" else temporary
    reached: list[bool] = []
    temporary.touch()  # says here whether it can be written, where the message is not one of ffmpeg
    try:
        with cast(Any, imageio.get_writer)(target, **options) as video:
            for number, goal in enumerate(chosen, 1):
                act = mpc_actions(policy)  # which begins anew, as in an evaluation
                observation, info = env.reset(seed=seed + number, options={"goal": goal})
                title = f"goal {number} of {len(chosen)}"
                picture = _captioned(env, f"{title}    0.0 s    {task.say(info)}", "")
                video.append_data(picture)
                for step in range(1, task.episode_steps + 1):
                    state = torch.from_numpy(np.asarray(observation["state"], np.float64)[None])
                    context = [observation[CONTEXT]] if CONTEXT in observation else []
                    inputs = [torch.from_numpy(np.asarray(value, np.float64)[None]) for value in (goal, *context)]
                    action, _ = act(state, *inputs)
                    observation, _, _, _, info = env.step(action[0])
                    verdict = "" if step < task.episode_steps else ("reached" if info["success"] else "missed")
                    text = f"{title}    {step * task.step_seconds:.1f} s    {task.say(info)}"
                    picture = _captioned(env, text, verdict)
                    video.append_data(picture)
                for _ in range(round(1.0 / task.step_seconds)):
                    video.append_data(picture)
                reached.append(bool(info["success"]))
        if isinstance(target, io.BytesIO):
            temporary.write_bytes(target.getvalue())
        elif kind == ".mp4" and b"moov" not in temporary.read_bytes():  # the index, which comes last
            raise OSError("no room for the whole film, of which ffmpeg itself says nothing")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return reached


def _captioned(env: gymnasium.Env[Any, Any], text: str, verdict: str) -> np.ndarray:
    from PIL import Image, ImageDraw, ImageFont

    try:
        picture = Image.fromarray(np.asarray(env.render()))
    except Exception as error:  # whatever a renderer of others may raise
        raise NoPictureError(
            f"{type(error).__name__}: {error}; where there is no screen, set MUJOCO_GL=egl before Python starts"
        ) from error
    draw = ImageDraw.Draw(picture, "RGBA")
    size = max(10, picture.height // 30)
    font = ImageFont.load_default(size)
    draw.rectangle((0, 0, picture.width, 2 * size), fill=(0, 0, 0, 140))
    draw.text((size, size // 2), text, font=font, fill="white")
    if verdict:
        color = (90, 220, 120) if verdict == "reached" else (255, 120, 90)
        draw.text((picture.width - size, size // 2), verdict, font=font, fill=color, anchor="ra")
    return np.asarray(picture)
