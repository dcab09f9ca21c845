"""Actuators of a MuJoCo model: servos, activation, and limits of control and force."""

from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from difflcs._checks import broadcast_batch, check_kind, check_tensor
from difflcs.errors import InvalidInputError, ShapeError
from difflcs.physics.mujoco._native import _mujoco  # pyright: ignore[reportMissingModuleSource]
from difflcs.physics.mujoco.native import flags, to_numpy

Array = NDArray[np.float64]

_SLEEP = int(getattr(mujoco.mjtEnableBit, "mjENBL_SLEEP", 0))  # of MuJoCo 3.4 and later
_JOINT, _SITE = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_SITE)
_JOINTS = _JOINT, int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_SCALAR = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))
_DECIMETRE = 0.1  # size of an action of a servo on a slide [m]
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_FIXED, _UNBIASED, _AFFINE = (
    int(v) for v in (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)
)
_NONE, _INTEGRATOR, _FILTER, _EXACT, _MUSCLE, _USER = DYNAMICS = tuple(
    int(getattr(mujoco.mjtDyn, f"mjDYN_{name}"))
    for name in ("NONE", "INTEGRATOR", "FILTER", "FILTEREXACT", "MUSCLE", "USER")
)
"""Activation dynamics whose rate does not depend on the time step."""


class Actuators:
    """The actuators of a model: which are position servos on joints, which joints they move, and what limits them.

    Args:
        model: the model.
        stops: False if joints have no limits.

    Attributes:
        dof: (nu,) degree of freedom of each actuator on a slide or hinge; −1 for others.
        gear: (nu,).
        servo: (nu,) True for a `position` actuator on a slide or hinge.
        offset: (nu,) at which length a servo rests with ctrl = 0, by the constant part of its bias; 0 for others.
        drifts: (nu,) True if MuJoCo gives it the length zero wherever it is: on free joints, on sites without refsite.
        holds: (nu,) True if its force falls to zero at some length, as that of servos on joints or tendons does.
        follows: (nu,) True if it has no activation, or one that goes to its control.
        activated: (na,) actuator of each activation.
        range: (2, nu) controls that it takes; infinite where it takes any.
        usual: (nu,) size of actions where there is no range: 1; of a servo on a slide, a decimetre, or two and a half
            times what the joint's limits leave.
        reach: (nu,) size of actions: half of the range, or 1.
        brakes: (nv,) damping by drives on slides and hinges whose force is limited, or that of the joint.
        gain, constant, bias, damping: (nu,) of the force: gain · control + constant + bias · length + damping · rate.
        affine: (nu,) True if this is all, where activation has settled.
        straight: (nu,) True if the length is linear in the positions of slides and hinges.
        force: (2, nu) limits of the force; infinite where it has none.
        curved: (k,) those with a range whose force is not linear in the control, such as dampers and muscles.
    """

    def __init__(self, model: Any, stops: bool):
        joint = model.actuator_trnid[:, 0]
        self.dof = np.full(model.nu, -1)
        self.drifts = (model.actuator_trntype == _SITE) & (model.actuator_trnid[:, 1] < 0)
        for i in np.flatnonzero(np.isin(model.actuator_trntype, _JOINTS)):
            self.drifts[i] = (kind := model.jnt_type[joint[i]]) == _FREE
            if model.actuator_trntype[i] == _JOINT and kind in _SCALAR:
                self.dof[i] = model.jnt_dofadr[joint[i]]
        self.gear = model.actuator_gear[:, 0].copy()
        affine = model.actuator_biastype == _AFFINE
        gain, (constant, bias, damping) = model.actuator_gainprm[:, 0], model.actuator_biasprm.T[:3] * affine
        dynamics = np.array(model.actuator_dyntype)
        self.follows = np.isin(dynamics, (_NONE, _FILTER, _EXACT))
        fixed = (model.actuator_gaintype == _FIXED) & (gain != 0) & self.follows
        linear = fixed & affine
        self.servo = (self.dof >= 0) & linear & (np.abs(gain + bias) <= 1e-9 * np.abs(gain))
        self.holds = linear & (bias != 0) & ~self.drifts
        self.gain, self.constant, self.bias, self.damping = np.where(gain != 0, gain, 1.0), constant, bias, damping
        self.offset = np.where(self.servo, constant / self.gain, 0.0)
        limited = np.array(model.actuator_ctrllimited, dtype=bool)
        limited &= not model.opt.disableflags & flags("CLAMPCTRL")
        self.range = np.where(limited, model.actuator_ctrlrange.T, [[-np.inf], [np.inf]])
        self.range[:, dynamics == _MUSCLE] = np.clip(self.range[:, dynamics == _MUSCLE], 0.0, 1.0)
        slides = self.holds & (self.dof >= 0) & (model.jnt_type[model.dof_jntid[self.dof]] == _SCALAR[0])
        joints = model.dof_jntid[self.dof]
        limited = model.jnt_limited[joints].astype(bool)
        width = np.ptp(model.jnt_range[joints], axis=1) * limited
        self._stops = np.where(limited & (self.dof >= 0) & stops, model.jnt_range[joints].T, [[-np.inf], [np.inf]])
        self.usual = np.where(slides, np.maximum(_DECIMETRE, 2.5 * np.abs(self.gear) * width), 1.0)
        self.reach = np.where(np.isfinite(self.range).all(0), 0.5 * np.ptp(self.range, axis=0), 1.0)
        bends = (model.actuator_gaintype != _FIXED) | (dynamics == _MUSCLE)
        self.curved = np.flatnonzero(bends & (np.ptp(self.range, axis=0) > 0) & np.isfinite(self.range).all(0))
        plain = fixed & (affine & (self.dof >= 0) | (model.actuator_biastype == _UNBIASED))
        self.force = self._force_limits(model, joint)
        self._force = np.where(plain, self.force, [[-np.inf], [np.inf]])
        limited = np.isfinite(self._force).any(0) | model.jnt_actfrclimited[joints].astype(bool)
        brakes = np.where(limited & (self.dof >= 0), -damping * self.gear**2, 0.0)
        self.brakes = np.bincount(self.dof.clip(0), brakes.clip(0), minlength=model.nv)
        tendon = model.wrap_type[model.tendon_adr] == int(mujoco.mjtWrap.mjWRAP_JOINT)
        of_tendon = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)
        self.affine = linear & ~disabled_actuators(model)
        self.straight = self.dof >= 0
        self.straight[of_tendon] = tendon[joint[of_tendon]]
        self._exact = np.flatnonzero(dynamics == _EXACT)
        self.activated = np.repeat(np.arange(model.nu), model.actuator_actnum)
        self._decays = dynamics[self.activated] == _EXACT
        self._time = np.maximum(model.actuator_dynprm[self.activated, 0], 1e-15)
        self._muscles = np.flatnonzero(dynamics[self.activated] == _MUSCLE)
        self._rates = model.actuator_dynprm[self.activated, :2].copy()
        trees, own = _find_trees(model)
        parts, end = (trees, trees, own[self.activated], own), 2 * model.nv + model.na + model.nu
        self._trees, self._together = np.concatenate(parts), []
        for kind in range(3, -1, -1):  # positions last, as what depends on them is kept till then
            end -= len(part := parts[kind])  # of each tree the first, then the second, ...
            order = np.array([(part[:i] == tree).sum() for i, tree in enumerate(part)], dtype=np.intp)
            self._together += [(kind, (np.flatnonzero(order == k) + end).tolist()) for k in np.unique(order)]

    def _force_limits(self, model: Any, joint: NDArray[np.intp]) -> Array:
        """Compute the forces (2, nu) that actuators may have, infinite where nothing limits them."""
        none = np.array([[-np.inf], [np.inf]])
        force = np.where(np.array(model.actuator_forcelimited, dtype=bool), model.actuator_forcerange.T, none)
        alone = (self.dof >= 0) & (np.bincount(self.dof + 1, minlength=1)[self.dof + 1] == 1) & (self.gear != 0)
        for i in np.flatnonzero(alone):
            if model.jnt_actfrclimited[joint[i]]:
                low, high = np.sort(model.jnt_actfrcrange[joint[i]] / self.gear[i])
                force[:, i] = np.maximum(force[0, i], low), np.minimum(force[1, i], high)
        return force

    def yields(self, moved: Array, velocity: Array | float) -> Array:
        """Part (nu,) of its force that an actuator keeps at the end of a step, as it moves.

        Args:
            moved: (nv, nv) how far a unit of force moves in a step in which actuators resist.
            velocity: (nv, nv) the velocity that it brings about.
        """
        resists = np.maximum(-self.bias, 0.0)[:, None, None] * moved
        resists += np.maximum(-self.damping, 0.0)[:, None, None] * velocity
        lost = self.gear**2 * resists[np.arange(len(self.dof)), self.dof, self.dof]
        return np.where(self.dof >= 0, np.clip(1 - lost, 0.01, 1.0), 1.0)

    def nominal(self, ctrl: Tensor, batch: torch.Size) -> Array:
        """Return nominal controls (*batch, nu) as an array.

        Raises:
            ShapeError and its kinds: controls that do not fit.
        """
        check_tensor("ctrl", ctrl, [("n_u", len(self.dof))])
        if broadcast_batch([("x", batch), ("ctrl", ctrl.shape[:-1])]) != batch:
            raise ShapeError(
                f"ctrl: expected one nominal control for each of the states {tuple(batch)}, or one for all, got "
                f"{tuple(ctrl.shape)}; leave out its batch dimensions, or give x the same"
            )
        return to_numpy(ctrl.expand(*batch, len(self.dof)))

    def _length(self, x: Array) -> Array:
        """Length (..., nu) of actuators on joints, or its rate, from positions or velocities that x begins with."""
        return self.gear * x[..., self.dof.clip(0)]

    def bounds(self, x: Array, velocity: Array, yields: Array, relative: bool) -> tuple[Array, Array]:
        """Actions (..., nu) with controls in their range, and forces in a step within their limits as far as known.

        Args:
            x: (..., n_x) states, which begin with the positions.
            velocity: (..., n) likewise.
            yields: (nu,) what motion leaves of a force, see above.
            relative: True if actions of servos count from where they are.
        """
        length, (low, high) = self._length(x), self.range
        if np.isfinite(self._force).any():
            others = self.constant + self.bias * length + self.damping * self._length(velocity)
            sides = np.sort([(force / yields - others) / self.gain for force in self._force], axis=0)
            # Where the range leaves no such force, the control is at its end.
            low, high = np.clip(sides, *self.range[:, None])
        length = length * (self.servo & relative)
        return low - length, high - length

    def places(self, x: Array) -> tuple[Array, Array]:
        """Compute how far driven joints may go (..., nu), in the range of controls and up to their stops, from x."""
        moves = np.where(self.servo & (self.gear != 0), self.gear, 1.0)
        low, high = np.sort([(end + self.offset - self._length(x)) / moves for end in self.range], axis=0)
        first, last = (stop - x[..., self.dof.clip(0)] for stop in self._stops)
        return np.maximum(np.where(self.servo, low, first), first), np.minimum(np.where(self.servo, high, last), last)

    def control(self, x: Tensor, u: Tensor, relative: bool, quasi_static: bool) -> Tensor:
        """Convert actions u (..., nu) at states x (..., n_x) to controls.

        Raises:
            InvalidInputError: quasi-static motion by actuators that are no `position` actuators.
        """
        if quasi_static and not self.servo.all():
            raise InvalidInputError(
                "model: expected position actuators to follow a quasi-static plan, got others; track x + u by your own "
                "controller"
            )
        gear = torch.from_numpy(self.gear).to(u)
        here = gear * x[..., torch.from_numpy(self.dof).clamp_min(0)]
        if quasi_static:
            return here + gear * u - torch.from_numpy(self.offset).to(u)
        return u + here * torch.from_numpy(self.servo) if relative else u

    def durations(self, seconds: float) -> Array:
        """Time (na,) by which an activation's rate at the beginning of a time step moves it in this step."""
        return np.where(self._decays, -self._time * np.expm1(-seconds / self._time), seconds)

    def even_out(self, ctrl: Array, activation: Array, rates: Array) -> None:
        """Give muscles one rate in both directions, that of the nominal control, in their rows of n linearised rates.

        Differences have the rate of activation by the control and that of deactivation by the activation.

        Args:
            ctrl: (n, nu) nominal controls.
            activation: (n, na) where it is linearised.
            rates: (n, nv + na, n_x + nu) rates of velocities and activation by the state and by control.
        """
        if not self._muscles.size:
            return
        i, at = self._muscles, activation[:, self._muscles]
        acts, row = self.activated[i], rates.shape[1] - len(self._time) + i
        (rise, fall), ctrl = self._rates[i].T, ctrl[:, acts]
        middle = 0.5 + 0.75 * (at + ctrl)
        rate = np.where(ctrl >= at, 1 / (rise * middle), middle / fall)
        n_x = rates.shape[2] - len(self.dof)
        rates[:, row] = 0.0
        rates[:, row, n_x - len(self._time) + i], rates[:, row, n_x + acts] = -rate, rate

    def unlimit_rates(self, model: Any) -> None:
        """Let activations of a model change by their rates, however long the step, to whatever value."""
        model.actuator_dyntype[self._exact], model.actuator_actlimited[:], model.actuator_actearly[:] = _FILTER, 0, 0

    def describe(
        self, simulated: Any, relative: Any = (), linearised: Any = None, steps: int = 0, advance: int = 0
    ) -> _mujoco.Motion:
        """Describe a motion for the compiled part: models, MuJoCo's steps, and what balances and limits the controls.

        Actions of the actuators `relative` count from where they are. The models must outlive it.
        """
        fields = {name: getattr(simulated, name) for name in ("nq", "nv", "nu", "na")}
        fields |= {"simulated": simulated._address, "linearised": (linearised or simulated)._address}
        free = flags("CONTACT", "CONSTRAINT") & simulated.opt.disableflags
        fields["held"] = linearised is not None and not free
        low, high = self.range
        arrays = {"gain": self.gain, "constant": self.constant, "bias": self.bias, "low": low, "high": high}
        arrays |= {"holds": self.holds, "relative": np.isin(np.arange(len(self.dof)), relative)}
        arrays |= {"activated": self.activated, "tree": self._trees}
        listed = {name: values.tolist() for name, values in arrays.items()}
        return _mujoco.Motion(fields | listed | {"together": self._together, "steps": steps, "advance": advance})


def _find_trees(model: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """Trees (nv,) of degrees of freedom and (nu,) of actuators; where anything but contacts may join them, one."""
    joined = model.ntendon or model.neq or model.nplugin or not np.isin(model.actuator_trntype, _JOINTS).all()
    joint, trees = model.actuator_trnid[:, 0] * (not joined), np.array(model.dof_treeid) * (not joined)
    return trees, trees[model.jnt_dofadr[joint]]


def disabled_actuators(model: Any) -> NDArray[np.bool_]:
    """Return a mask (nu,) of actuators that do nothing, by their groups or a flag of the model."""
    groups = model.actuator_group
    disabled = (groups >= 0) & (groups < 31) & (model.opt.disableactuator >> groups.clip(0, 30) & 1 > 0)
    return disabled | bool(model.opt.disableflags & flags("ACTUATION"))


def check_model(model: Any, data: Any, motion: str) -> None:
    """Check that a model and its data are such as a motion has."""
    check_kind("model", model, mujoco.MjModel, "load one, MjModel.from_xml_path, or compile its MjSpec")
    check_kind("data", data, (mujoco.MjData, type(None)), "pass mujoco.MjData(model)")
    if data is not None and len(data.qpos) != model.nq:
        raise InvalidInputError(f"data: expected nq={model.nq} of the model, got {len(data.qpos)}; pass MjData(model)")
    dynamics, plugins = np.array(model.actuator_dyntype), np.array(model.actuator_plugin)

    def actuators(those: Any) -> str:
        return ", ".join(f"actuator {model.actuator(i).name or i!r}" for i in np.flatnonzero(those).tolist())[:200]

    controls, delays, yields = (getattr(model, name, 0) for name in ("nactuator", "nhistory", "nplastic"))
    refused = {  # what is wanted, and what there is instead
        "joints, as nothing moves without": not model.nv and "none",
        "one control for each actuator, not those of <pid> and <orientation>": controls not in (0, model.nu) and "more",
        "activation by an integrator, a filter, a muscle or a callback, not by <dcmotor>, <pid> or a plugin": actuators(
            ~np.isin(dynamics, DYNAMICS) & (model.actuator_actnum > 0) | (plugins >= 0)
        ),
        "no <adhesion>, whose force depends on what is in contact": actuators(
            model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_BODY)
        ),
        "rigid bodies, no <flex>": model.nflex and f"{model.nflex} of these",
        "no delay of actuators and sensors (delay, nsample), which would need their past as states": delays and "some",
        "springs that do not yield (springyield), which would need their rest lengths as states": yields and "others",
        'no <flag sleep="enable"/>, as what sleeps does not follow its forces': model.opt.enableflags & _SLEEP and "it",
        "actuators that are not disabled (actuatorgroupdisable, <flag actuation/>) in quasi-static motion, which moves "
        "what they drive": actuators(disabled_actuators(model) & (motion == "quasi-static")),
    }
    for wanted, present in refused.items():
        if present:
            raise InvalidInputError(f"model: expected {wanted}, got {present}; remove or replace it in the model")
