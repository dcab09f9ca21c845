"""LCS-RL: the warm-up and the main phase as one trainer, on a small pushing system that needs no simulator."""

import torch

from difflcs.rl import LCSRL, Epochs, Rollouts, Warmup, WarmupSettings
from difflcs.rl.learning.ppo import PPO
from difflcs.rl.learning.state_tree import copy_state
from tests.training import slide


def make_lcsrl(models: bool = False, **changes) -> LCSRL:
    lcs = slide.make_model()
    mpc = slide.make_mpc(lcs)
    settings = WarmupSettings(rollouts=Rollouts(first=2, each=3), noise=0.02, epochs=Epochs(3, 2, 8))
    warmup, envs = Warmup(lcs, mpc, slide.make_envs(3), settings, 0, slide.STEPS), slide.make_envs()

    def make_main(first_episode: int, first_iteration: int) -> PPO:
        options = {"first_episode": first_episode, "first_iteration": first_iteration}
        options["total_episodes"] = 8 + 2 * slide.ROLLOUTS
        rollouts = slide.make_models(0, 2, iterations=1, rollouts=5) if models else None
        return slide.make_ppo(0, env=envs, models=rollouts, controller=mpc, options=options, **changes)

    return LCSRL(warmup, 8 * slide.STEPS, make_main)


def test_phases_follow_each_other():
    trainer = make_lcsrl()
    reports = [trainer.step() for _ in range(5)]
    assert [type(report).__name__ for report in reports] == ["WarmupReport"] * 3 + ["PPOReport"] * 2
    assert [report.iteration for report in reports] == [1, 2, 3, 4, 5]
    assert [report.env_steps for report in reports] == [
        slide.STEPS * n for n in (2, 5, 8, 8 + slide.ROLLOUTS, 8 + 2 * slide.ROLLOUTS)
    ]


def test_episodes_of_both_phases_differ():
    """The main phase goes on in the stream of the warm-up, where that has ended."""
    trainer, seeds = make_lcsrl(), []
    for _ in range(5):
        env = trainer.current.env if isinstance(trainer.current, Warmup) else trainer.current.robot.env
        count, reset = trainer.episodes, env.reset
        env.reset = lambda reset=reset, **options: (seeds.append(options["seed"]), reset(**options))[1]
        trainer.step()
        del env.reset
        seeds[-1] = seeds[-1][: trainer.episodes - count]
    flat = [seed for part in seeds for seed in part]
    assert len(set(flat)) == len(flat) == 8 + 2 * slide.ROLLOUTS


def test_a_trainer_goes_back_to_a_phase():
    """A state of either phase can be loaded in either phase."""
    trainer = make_lcsrl()
    trainer.step()
    early = copy_state(trainer.state_dict())
    for _ in range(3):
        trainer.step()
    late, state = slide.parameters(trainer), copy_state(trainer.state_dict())
    trainer.load(early)
    assert isinstance(trainer.current, Warmup)
    assert (trainer.iteration, trainer.env_steps) == (1, 2 * slide.STEPS)
    trainer.load(state)
    assert isinstance(trainer.current, PPO)
    assert slide.same(late, slide.parameters(trainer))


def test_the_main_phase_remembers_the_warm_up():
    trainer = make_lcsrl(models=True)
    for _ in range(3):
        trainer.step()
    assert len(trainer.current.models) == 8
    trainer.step()
    assert len(trainer.current.models) == 8 + slide.ROLLOUTS


def test_what_is_handed_out_is_bounded_on_states_of_the_warm_up():
    """Inside its episodes: PPO takes no step on these states, and model rollouts do not start there."""
    trainer, seen = make_lcsrl(models=True, gain=-3.0), []
    for _ in range(3):
        trainer.step()
    inside, incumbent = trainer.current.models.episodes["state"][:, 1:].unique(), trainer.current.incumbent
    follow = incumbent.follow
    incumbent.follow = lambda model, held_out: (seen.append(held_out), follow(model, held_out))
    for _ in range(2):
        trainer.step()
    assert all(bool(torch.isin(one["state"], inside).all()) for one in seen)
    assert len(seen[0]["state"].unique()) == len(inside)
