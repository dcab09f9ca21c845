"""Draws passes.png: what plans of one pass and of several say, and what MuJoCo does with their actions.

`python docs/figures/passes.py`. A sphere pushes a door open, quasi-static, 10 steps of 0.1 s; a motor turns a pendulum
upright, dynamic, 20 steps of 0.05 s. The actions are executed without looking again.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import mujoco
import numpy as np
import torch

from difflcs import LCSMPCLayer, QuadraticCost
from difflcs.physics.mujoco import MujocoLCS

DOOR = """<mujoco><option timestep=".002" integrator="implicitfast"/><worldbody>
  <body><joint name="angle" type="hinge" axis="0 0 1" damping=".5"/>
    <geom type="box" pos=".15 0 0" size=".15 .01 .05" mass=".5" friction=".3"/></body>
  <body pos=".2 -.04 0"><joint name="px" type="slide" axis="1 0 0"/><joint name="py" type="slide" axis="0 1 0"/>
    <geom type="sphere" size=".02" mass=".2" friction=".3"/></body></worldbody>
  <actuator><position joint="px" kp="2000" dampratio="1"/><position joint="py" kp="2000" dampratio="1"/></actuator>
</mujoco>"""
PENDULUM = """<mujoco><option timestep=".005" integrator="RK4"/><worldbody><body>
  <joint name="q" axis="0 1 0" damping=".02"/><geom pos="0 0 -.5" size=".05" mass=".7"/></body></worldbody>
  <actuator><motor joint="q"/></actuator></mujoco>"""
# Title, model, options of MujocoLCS; horizon, largest action, goal; weights of states, of actions, at the end.
CASES = (
    ("a door, to 1.4 rad", DOOR, {"mobility": "damping"}, (10, 0.05, 1.4), ((10.0, 0.0, 0.0), 20.0, (100.0, 0.0, 0.0))),
    (
        "a pendulum, upright",
        PENDULUM,
        {"motion": "dynamic", "seconds": 0.05},
        (20, 4.1, np.pi),
        ((0.1, 0.01), 0.05, (200.0, 20.0)),
    ),
)


def main() -> None:
    """Draw."""
    plt.rcParams["font.size"] = 12  # legible on a phone
    figure, axes = plt.subplots(1, 2, figsize=(7, 3.6), layout="constrained")
    for axis, (title, xml, options, (horizon, most, to), (stage, effort, final)) in zip(axes, CASES, strict=True):
        model = mujoco.MjModel.from_xml_string(xml)
        module = MujocoLCS(model, **options)
        goal = torch.zeros(module.n_x, dtype=torch.float64)
        goal[0] = to
        Q, Q_final = (torch.diag(torch.tensor(v, dtype=torch.float64)) for v in (stage, final))
        R = effort * torch.eye(module.n_u, dtype=torch.float64)
        cost = QuadraticCost(Q, R, Q_final, q=-Q @ goal, q_final=-Q_final @ goal)
        time = module.seconds * np.arange(horizon + 1)
        for i, passes in enumerate((1, 2, 5)):
            plan = LCSMPCLayer(module, cost, horizon, -most, most, passes=passes)(torch.zeros_like(goal))
            data, angle = mujoco.MjData(model), [0.0]
            for x, u in zip(plan.x[:-1], plan.u, strict=True):
                data.ctrl[:] = module.control(x, u).numpy()
                mujoco.mj_step(model, data, round(module.seconds / model.opt.timestep))
                angle.append(data.qpos[0])
            axis.plot(time, angle, color=f"C{i}", label=f"passes={passes}")
            axis.plot(time, plan.x[:, 0], color=f"C{i}", ls=":")
            print(f"{title}, passes={passes}: {plan.x[-1, 0]:.3f} planned, {angle[-1]:.3f} in MuJoCo")
        axis.axhline(to, color="0.7", lw=0.8, zorder=0)
        axis.set_title(title)
        axis.set_xlabel("time [s]")
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("angle [rad]\nplanned (dotted), in MuJoCo")
    axes[0].legend(frameon=False)
    figure.savefig(Path(__file__).with_name("passes.png"), dpi=150)


if __name__ == "__main__":
    main()
