"""System identification: numbers of a MuJoCo model are fitted to observed motion, by MuJoCo's own steps."""

import mujoco
import mujoco.rollout
import numpy as np
import torch
from torch import Tensor

from difflcs._checks import check_kind, check_positive_int, check_shape, takes_arrays
from difflcs.errors import ContactWarning, InvalidInputError, ShapeError, warn
from difflcs.physics.mujoco.learnable import Array, LearnableMujocoLCS, slope
from difflcs.physics.mujoco.native import to_numpy

_REACH, _LEAST = 0.3, 4e-3  # over which differences are taken: at first, and when it is done
_FLOOR = 0.01  # least error of a number of the state, in parts of its mean motion in a step, that counts
_ROUNDING = 1e-6  # change of any entry, in parts of its error, per e-fold of a parameter, that is only rounding
_LEAD = 2  # actions that bring about the velocities of states without any
_USER = mujoco.mjtState.mjSTATE_USER


@takes_arrays
def identify(module: LearnableMujocoLCS, x: Tensor, u: Tensor, iterations: int = 20) -> list[float]:
    """Fit the parameters of a module to observed motion, by simulating that motion with MuJoCo's own steps.

    Each motion is simulated from its first state with the controls that were executed. Gauss–Newton steps minimise the
    sum of log(1 + (e/s)²) over all entries of all states, where e is the error of an entry and s its median over all
    states. This robust loss (Cauchy's, by iteratively reweighted least squares) keeps impacts, and joints that are
    predicted badly, from outweighing the rest. Derivatives are differences whose width is the length of the last step;
    an entry that changes by more than its error over that width counts less. The compliance, which MuJoCo does not
    have, is not fitted.

    Args:
        module: the model, changed in place. Mocap bodies and applied forces are as in its data.
        x: (..., H + 1, n_x) observed states. States without velocities get them from the first two steps, which start
            at rest, at the observed positions, and are not compared with what was observed: H is then 3 or more.
        u: (..., H, n_u) actions, which `MujocoLCS.control` converts to controls at the observed states.
        iterations: largest number of steps. A step simulates all motions twice for each parameter, and one to three
            times more.

    Returns:
        The mean of log(1 + (e/m)²) before each step, where m is how much an entry changes in one step, on average.

    Raises:
        InvalidInputError or a subclass: the arguments do not fit, or MuJoCo gives warnings in most of the motions.

    Warns:
        ContactWarning: the motion does not depend on one of the parameters near the value found.
    """
    check_kind("module", module, LearnableMujocoLCS, "fit others by violation_loss")
    state, lead = module.state, 0 if module.state.velocities else _LEAD
    check_shape("u", u, f"... {lead + 1}+ n_u", {"n_u": module.n_u}, "take longer motions")
    check_shape("x", x, "... H n_x", {"H": u.shape[-2] + 1, "n_x": module.n_x}, "one state more than actions")
    if x.shape[:-2] != u.shape[:-2] or not u.numel():
        raise ShapeError(f"x, u: expected the same batch of one motion or more, got {[*x.shape]} and {[*u.shape]}")
    ctrl = to_numpy(module.control(x[..., :-1, :], u)).reshape(-1, *u.shape[-2:])
    begin = state.flatten(x, module._data.act).reshape(len(ctrl), u.shape[-2] + 1, -1)
    seen = state.to_state(*np.split(begin, [state.nq, state.nq + state.nv], -1))  # no rotation beyond half a turn
    usual, seen = (seen[:, 1:] - seen[:, :-1]).abs().mean((0, 1)).clamp_min(1e-12), seen[:, 1 + lead :]

    def miss(change: Tensor) -> tuple[Tensor, int]:
        after, broken = _simulate(module, change, begin, ctrl, lead)
        return after - seen, broken

    learned = {s + k: f"{kind} {name}" for kind, name, ids, s, n in module._entries for k in range(n) if ids}
    at, reach, losses, silent = module.change.detach().clone(), _REACH, [], []
    ways, (missed, broken) = torch.eye(len(at), dtype=at.dtype)[list(learned)], miss(at)
    if 2 * broken > len(begin):
        raise InvalidInputError(
            f"x, u: expected motions that MuJoCo can simulate, got its warnings in {broken} of {len(begin)}; see "
            f"MUJOCO_LOG.TXT, pass shorter motions, or start from a better guess"
        )
    while len(losses) < check_positive_int("iterations", iterations) and reach > _LEAST:
        losses.append(float((missed / usual).square().log1p().mean()))
        scale = missed.abs().flatten(0, 1).median(0).values + _FLOOR * usual
        errors = missed / scale
        ends = [[(miss(at + sign * reach * way)[0] - missed) / scale for sign in (1, -1)] for way in ways]
        J = torch.stack([slope(*both) for both in ends], -1) / reach
        silent = [n for n, j in zip(learned.values(), J.unbind(-1), strict=True) if j.abs().max() < _ROUNDING]
        weighted = J / (1 + errors.square() + (reach * J).square().sum(-1)).unsqueeze(-1)
        A = torch.einsum("nti...,ntij->...j", J, weighted)
        step = torch.linalg.solve(A + (1e-6 * A.diag() + 1e-9).diag(), -torch.einsum("ntij,nti->j", weighted, errors))
        step = step @ ways / max(1.0, float(step.abs().max()))  # parameters are of size 1
        least, start = errors.square().log1p().mean(), at
        for length in (1, 2, 4):
            other, _ = miss(start + length * step)
            if not (value := (other / scale).square().log1p().mean()) < least:
                break
            least, missed, at = value, other, start + length * step
        reach = min(_REACH, max(float((at - start).abs().max()), reach / 3))
    if silent:
        said = f"the motion does not depend on {', '.join(silent)} near the values found, which may be wrong"
        warn(f"{said}; add motion that does", ContactWarning)
    with torch.no_grad():
        module.change.copy_(at)
    return losses


def _simulate(module: LearnableMujocoLCS, change: Tensor, begin: Array, ctrl: Array, lead: int) -> tuple[Tensor, int]:
    """Simulate from `begin` (n, H + 1, nq + nv + na) by controls (n, H, nu).

    Returns:
        States (n, H − lead, n_x), and in how many motions MuJoCo gave a warning, after which they stand still.
    """
    model, seconds = module._changed(to_numpy(change)), module.physics.seconds
    count = max(1, round(seconds / model.opt.timestep))
    model.opt.timestep = seconds / count
    given = np.zeros(mujoco.mj_stateSize(model, _USER))
    mujoco.mj_getState(model, module._data, given, _USER)
    held = np.concatenate([ctrl, np.broadcast_to(given[model.nu :], (*ctrl.shape[:2], len(given) - model.nu))], -1)
    threads, after = [mujoco.MjData(model) for _ in range(torch.get_num_threads())], begin[:, :1]
    for k in range(lead + 1):  # at the places that were observed
        first = np.concatenate([np.zeros((len(begin), 1)), begin[:, k, : model.nq], after[:, -1, model.nq :]], -1)
        actions = held[:, k : k + 1 if k < lead else None].repeat(count, 1)
        states, _ = mujoco.rollout.rollout(model, threads, first, actions, control_spec=int(_USER))
        after = states[:, count - 1 :: count, 1:]
    broken = int((states[:, -1, 0] < (actions.shape[1] - 0.5) * model.opt.timestep).sum())  # where time has stopped
    return module.state.to_state(*np.split(after, [model.nq, model.nq + model.nv], -1)), broken
