"""LCS-RL: the warm-up and the main phase as one trainer, on a small pushing system that needs no simulator."""

from difflcs.rl import LCSRL, Epochs, Rollouts, Warmup, WarmupSettings
from difflcs.rl.learning import ppo_settings
from difflcs.rl.learning.policy import make_actor
from difflcs.rl.learning.ppo import PPO
from difflcs.rl.learning.state_tree import copy_state
from tests.training.slide import (
    PENALTY,
    ROLLOUTS,
    STEPS,
    features,
    make_envs,
    make_model,
    make_models,
    make_mpc,
    parameters,
    same,
    small_settings,
)


def make_lcsrl(seed: int = 0, models: bool = False, **changes) -> LCSRL:
    lcs = make_model()
    mpc = make_mpc(lcs)
    settings = WarmupSettings(rollouts=Rollouts(first=2, each=3), noise=0.02, epochs=Epochs(3, 2, 8))
    warmup, envs = Warmup(lcs, mpc, make_envs(3), settings, seed, STEPS), make_envs()

    ppo = small_settings(**changes)

    def make_main(first_episode: int, first_iteration: int) -> PPO:
        return ppo_settings.make_ppo(
            make_actor(mpc, ppo.std, ppo.covariance),
            envs,
            ppo,
            seed,
            features=features,
            total_episodes=8 + 2 * ROLLOUTS,
            episode_steps=STEPS,
            first_episode=first_episode,
            first_iteration=first_iteration,
            failure_penalty=PENALTY,
            models=make_models(seed, 2, iterations=1, rollouts=5) if models else None,
        )

    return LCSRL(warmup, 8 * STEPS, make_main)


def test_phases_follow_each_other():
    trainer = make_lcsrl()
    reports = [trainer.step() for _ in range(5)]
    assert [type(report).__name__ for report in reports] == ["WarmupReport"] * 3 + ["PPOReport"] * 2
    assert [report.iteration for report in reports] == [1, 2, 3, 4, 5]
    assert [report.env_steps for report in reports] == [STEPS * n for n in (2, 5, 8, 8 + ROLLOUTS, 8 + 2 * ROLLOUTS)]


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
    assert len(set(flat)) == len(flat) == 8 + 2 * ROLLOUTS


def test_a_trainer_goes_back_to_a_phase():
    """A state of either phase can be loaded in either phase."""
    trainer = make_lcsrl()
    trainer.step()
    early = copy_state(trainer.state_dict())
    for _ in range(3):
        trainer.step()
    late, state = parameters(trainer), copy_state(trainer.state_dict())
    trainer.load(early)
    assert isinstance(trainer.current, Warmup)
    assert (trainer.iteration, trainer.env_steps) == (1, 2 * STEPS)
    trainer.load(state)
    assert isinstance(trainer.current, PPO)
    assert same(late, parameters(trainer))


def test_the_main_phase_remembers_the_warm_up():
    trainer = make_lcsrl(models=True)
    for _ in range(3):
        trainer.step()
    assert len(trainer.current.models) == 8
    trainer.step()
    assert len(trainer.current.models) == 8 + ROLLOUTS
