"""Stochastic policies as TorchRL actors: Gaussians around the action of the MPC (Eq. 6 of the paper) or a network's.

They write "loc", "scale_tril", "action" and "action_log_prob", and are what `difflcs.rl.PPO` trains.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.distributions import MultivariateNormal
from torch.func import functional_call

from difflcs._checks import check_choice, check_kind, check_number, check_tensor
from difflcs._differentiation import runs_eagerly
from difflcs._modules import fresh
from difflcs._optional import INSTALL
from difflcs.errors import InvalidInputError, MissingDependencyError
from difflcs.lcs import is_plain
from difflcs.mpc import LCSMPCLayer
from difflcs.mpc.solution import Primal
from difflcs.records import LCSModule, LCSParams, LCSSequence
from difflcs.rl.learning.checks import check_module
from difflcs.rl.learning.jacobian import system_jacobian
from difflcs.rl.learning.mlp import MLPController
from difflcs.rl.rollout import CONTEXT, ignore_solver_warnings

try:
    from tensordict import TensorDict, TensorDictBase
    from tensordict.nn import InteractionType, TensorDictModuleBase
    from torchrl.data import Composite, Unbounded
    from torchrl.modules import ProbabilisticActor
except ImportError as error:
    raise MissingDependencyError(f"expected the package torchrl, not installed; run: {INSTALL}") from error

COVARIANCES = ("fixed", "diagonal", "full")
PLAN = ("x", "u", "lam")
"""Entries of the nested keys "plan" and "guess"."""


class GaussianParameters(TensorDictModuleBase):
    """Observations → mean and Cholesky factor of a Gaussian. Subclasses compute the mean.

    Σ = L Lᵀ with L = diag(exp(log_std)) (I + strictly lower triangle of `mixing`), the same for all observations.

    Args:
        std: (n_u,) standard deviations.
        covariance: the learned part of Σ, "fixed", "diagonal" or "full".
        in_keys: keys that the mean depends on.
        out_keys: keys that are written besides "loc" and "scale_tril".
    """

    def __init__(self, std: Tensor, covariance: str, in_keys: Sequence[str], out_keys: Sequence = ()):
        super().__init__()
        check_choice("covariance", covariance, COVARIANCES)
        self.covariance = covariance
        self.in_keys = list(in_keys)
        self.out_keys = ["loc", "scale_tril", *out_keys]  # pyright: ignore
        self.log_std = nn.Parameter(std.log(), requires_grad=covariance != "fixed")
        n_u = len(std)
        self.mixing = nn.Parameter(torch.zeros(n_u, n_u, dtype=std.dtype), requires_grad=covariance == "full")

    def write(self, tensordict: TensorDictBase, mean: Tensor) -> TensorDictBase:
        """Write the Gaussian of mean (..., n_u), in its dtype."""
        tensordict["loc"] = mean
        tensordict["scale_tril"] = self.scale_tril().to(mean.dtype).expand(*tensordict.batch_size, -1, -1)
        return tensordict

    def scale_tril(self) -> Tensor:
        """L, (n_u, n_u)."""
        if self._forward_pre_hooks:
            fresh(self)
        unit = torch.eye(len(self.log_std), dtype=self.log_std.dtype) + self.mixing.tril(-1)
        return self.log_std.exp().unsqueeze(-1) * unit


class MPCGaussian(GaussianParameters):
    """State, goal and context → Gaussian around the MPC's action, and the plan behind it; see `LCSMPCPolicy`."""

    def __init__(self, mpc: LCSMPCLayer, std: Tensor, covariance: str, in_keys: Sequence[str]):
        super().__init__(std, covariance, in_keys, [*(("plan", name) for name in PLAN), "converged"])
        self.mpc = mpc

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Solve the MPC, starting from the key "guess" if there is one, else cold."""
        state, goal = _entries(tensordict, self.in_keys)
        solution = self.mpc(state, goal, guess=_guess(tensordict), context=tensordict.get(CONTEXT, None))
        plan = {name: getattr(solution, name).detach() for name in PLAN}
        tensordict["plan"] = TensorDict(plan, tensordict.batch_size)  # pyright: ignore[reportArgumentType]
        tensordict["converged"] = solution.converged.unsqueeze(-1)
        return self.write(tensordict, solution.action)


def _guess(tensordict: TensorDictBase) -> Primal | None:
    guess = tensordict.get("guess", None)
    return None if guess is None else Primal(*_entries(guess, PLAN))


def _entries(tensordict: TensorDictBase, keys: Sequence) -> list[Tensor]:
    """Read the inputs of a policy."""
    missing = [str(key) for key in keys if tensordict.get(key, None) is None]
    if missing:
        got = sorted(map(str, tensordict.keys()))
        raise InvalidInputError(f"data: expected the keys {list(keys)}, got {got}; add {', '.join(missing)}")
    return [tensordict[key] for key in keys]


class MLPGaussian(GaussianParameters):
    """State, goal and elapsed time → Gaussian around a network's action; see `MLPPolicy`."""

    def __init__(self, network: MLPController, std: Tensor, covariance: str):
        super().__init__(std, covariance, ("state", "goal", "elapsed"))
        self.network = network

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Evaluate the network."""
        seen = _entries(tensordict, self.in_keys)
        return self.write(tensordict, self.network.mean(*seen, context=tensordict.get(CONTEXT, None)))


class _Gaussian(MultivariateNormal):
    """A Gaussian of any batch: torch divides by the size of an empty one."""

    deterministic_sample = MultivariateNormal.mean  # by TorchRL's name

    def log_prob(self, value: Tensor) -> Tensor:
        return super().log_prob(value) if value.numel() else value.sum(-1)


class GaussianPolicy(ProbabilisticActor):
    """A TorchRL actor that draws from a Gaussian, as `difflcs.rl.PPO` needs it.

    Args:
        parameters: writes mean and Cholesky factor.

    Attributes:
        gaussian: the same module.
    """

    def __init__(self, parameters: GaussianParameters):
        n_u = len(parameters.log_std)
        super().__init__(
            parameters,  # pyright: ignore[reportArgumentType]
            in_keys=["loc", "scale_tril"],
            out_keys=["action"],
            spec=Composite(action=Unbounded(torch.Size([n_u]), dtype=torch.float64)),
            distribution_class=_Gaussian,
            distribution_kwargs={"validate_args": False},
            default_interaction_type=InteractionType.RANDOM,  # TorchRL's default is the mean
            return_log_prob=True,
        )
        self.gaussian = parameters

    @property
    def learned(self) -> LCSModule | LCSParams | LCSSequence | MLPController:
        """The model behind the mean: what is trained and saved."""
        raise NotImplementedError

    @property
    def controller(self) -> LCSMPCLayer | MLPController:
        """The policy without noise, for `difflcs.rl.evaluate`."""
        raise NotImplementedError

    @property
    def covariance(self) -> str:
        """The learned part of Σ: "fixed", "diagonal" or "full"."""
        return self.gaussian.covariance

    @property
    def std(self) -> Tensor:
        """(n_u,) standard deviation of each action component."""
        return self.gaussian.scale_tril().detach().square().sum(-1).sqrt()

    def solve(self, data: TensorDictBase) -> TensorDictBase:
        """Write mean and covariance for states (and guesses), with gradients, but no action.

        The caller counts failed solves ("converged"); a regularised gradient of single samples is expected.
        """
        with ignore_solver_warnings():
            self.get_dist_params(data)
        return data

    def act(self, data: TensorDictBase) -> TensorDictBase:
        """Write mean, covariance and a sample for states, without gradients and warnings."""
        with torch.no_grad(), ignore_solver_warnings():
            return self(data)


class LCSMPCPolicy(GaussianPolicy):
    """u ~ N(u_MPC(x, goal), Σ): exploration around the first action of the plan.

    A TorchRL `ProbabilisticActor` on tensordicts of any batch size:

    | key | read or written | shape |
    |-----|-----------------|-------|
    | "state", "goal" | read | (..., n_x), (..., n_goal) |
    | "context" | read if there | (..., n_context) what the system depends on besides the state |
    | ("guess", "x"), ("guess", "u"), ("guess", "lam") | read if there | start of the solver, for the same states |
    | "action" | written | (..., n_u) the sample, *not* clipped |
    | "action_log_prob" | written | (...) of this sample |
    | "loc", "scale_tril" | written | (..., n_u), (..., n_u, n_u) |
    | ("plan", "x"), ("plan", "u"), ("plan", "lam") | written | the solution; usable as "guess" |
    | "converged" | written | (..., 1) bool |

    The environment clips the action it executes. The policy does not, because a clipped Gaussian has no density, and
    the ratio of PPO must be that of the sample. Where an environment does not clip by itself, append TorchRL's
    `ClipTransform(in_keys_inv=["action"], low=…, high=…)`, or use `clip`.

    The MPC has local optima and a plan depends on where its solver started. Re-solve from the rollout's own solution,
    `data["guess"] = data["plan"]`, or the ratio is not 1 at unchanged parameters.

    Under `torchrl.envs.utils.set_exploration_type(ExplorationType.DETERMINISTIC)` the action is the mean.

    Samples are reparametrised: the log-probability of a sample drawn with gradients does not depend on the mean.
    Collect under `torch.no_grad()`, as collectors do, and let the loss compute the log-probability anew.

    docs/rl_stacks.md trains it in plain TorchRL, without `difflcs.rl.PPO`.

    Args:
        mpc: the controller; the LCS in it is trained, if it is an `LCSModel` or another `LCSModule` that is a
            `torch.nn.Module`. `on_failure="mask"` keeps a batch going where single solves fail.
        std: standard deviation of each action component, a number or (n_u,) [units of the action].
        covariance: "fixed"; or learned with the policy, "diagonal" or "full", that is with correlations.
        in_keys: keys of state and goal. TorchRL's `GymWrapper` renames "state" to "observation".

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
        MissingDependencyError: TorchRL is not installed.
    """

    def __init__(
        self,
        mpc: LCSMPCLayer,
        std: float | Tensor = 0.005,
        covariance: str = "fixed",
        in_keys: Sequence[str] = ("state", "goal"),
    ):
        check_kind("mpc", mpc, LCSMPCLayer)
        n_u = mpc.lcs.n_u
        if isinstance(in_keys, str) or len(in_keys) != 2:
            raise InvalidInputError(f"in_keys: expected two keys, of state and goal, got {in_keys!r}")
        super().__init__(MPCGaussian(mpc, _std(std, n_u), covariance, in_keys))

    gaussian: MPCGaussian

    @property
    def mpc(self) -> LCSMPCLayer:
        """The controller."""
        return self.gaussian.mpc

    @property
    def learned(self) -> LCSModule | LCSParams | LCSSequence:
        """The LCS."""
        return self.mpc.lcs

    @property
    def controller(self) -> LCSMPCLayer:
        """The MPC."""
        return self.mpc

    @runs_eagerly
    def jacobian(self, data: TensorDictBase) -> Tensor:
        """Compute the Jacobians of the mean, in standard deviations, with respect to the learned parameters of the LCS.

        Args:
            data: (N,) states and goals, contexts where there are any, and plans under "guess" to start from.

        Returns:
            (N, n_u, P) L⁻¹ ∂u/∂θ with Σ = L Lᵀ, P parameters of the LCS that require a gradient.

        Raises:
            InvalidInputError, DTypeError: the LCS has none, or is no `torch.nn.Module`.
        """
        lcs = check_module(self.mpc.lcs, name="actor")
        hooked = any(p._backward_hooks for p in lcs.parameters())  # such as a mask of gradients, which copies have not
        if hooked or not (is_plain(lcs) or getattr(lcs, "batched", False)):
            state, goal = _entries(data, self.in_keys)
            with ignore_solver_warnings():
                jacobian = system_jacobian(self.mpc, state, goal, _guess(data), data.get(CONTEXT, None))
            return torch.linalg.solve_triangular(self.gaussian.scale_tril().detach(), jacobian, upper=False)
        # Parameters that are matrices may have batch dimensions: a copy for each sample gets that sample's gradient.
        of_lcs = {id(p) for p in lcs.parameters()}
        learned = {name: p for name, p in self.gaussian.named_parameters() if id(p) in of_lcs and p.requires_grad}
        copies = {name: p.detach().expand(len(data), *p.shape).clone().requires_grad_() for name, p in learned.items()}
        batch = data.select(*self.in_keys, "guess", strict=False)
        with ignore_solver_warnings():
            functional_call(self.gaussian, copies, (batch,))
        mean = torch.linalg.solve_triangular(batch["scale_tril"].detach(), batch["loc"].unsqueeze(-1), upper=False)
        leaves, rows = list(copies.values()), []
        for component in mean.squeeze(-1).unbind(-1):
            gradients = torch.autograd.grad(component.sum(), leaves, retain_graph=True, materialize_grads=True)
            rows.append(torch.cat([part.flatten(1) for part in gradients], 1))
        return torch.stack(rows, 1)

    def clip(self, action: Tensor) -> Tensor:
        """Clip a sample into the controller's bounds, as it is executed."""
        return torch.minimum(torch.maximum(action, self.mpc.u_min), self.mpc.u_max)


class MLPPolicy(GaussianPolicy):
    """u ~ N(network(x, goal, elapsed), Σ): the reference point without a model.

    Keys as of `LCSMPCPolicy`, besides: "elapsed" (...), the fraction of the episode that has passed, is read; there is
    no guess, no plan and no "converged".

    Args:
        network: the mean.
        std: standard deviation of each action component, a number or (n_u,) [units of the action].
        covariance: "fixed"; or learned with the policy, "diagonal" or "full", that is with correlations.

    Raises:
        InvalidInputError and its kinds: an argument does not fit.
    """

    def __init__(self, network: MLPController, std: float | Tensor = 0.005, covariance: str = "diagonal"):
        super().__init__(MLPGaussian(network, _std(std, len(network.u_min)), covariance))

    gaussian: MLPGaussian

    @property
    def learned(self) -> MLPController:
        """The network."""
        return self.gaussian.network

    @property
    def controller(self) -> MLPController:
        """The network."""
        return self.gaussian.network


def make_actor(
    controller: LCSMPCLayer | MLPController, std: float | Tensor = 0.005, covariance: str = "fixed"
) -> GaussianPolicy:
    """Make the Gaussian policy around a controller: an `LCSMPCPolicy` or an `MLPPolicy`, see there."""
    kind = MLPPolicy if isinstance(controller, MLPController) else LCSMPCPolicy
    return kind(controller, std, covariance)  # pyright: ignore[reportArgumentType]


def _std(value: float | Tensor, n_u: int) -> Tensor:
    if isinstance(value, Tensor):
        std = check_tensor("std", value, [("n_u", n_u)]).detach().double().clone()
        if std.ndim != 1 or not bool((std > 0).all()):
            raise InvalidInputError(f"std: expected ({n_u},) positive numbers, got {std.tolist()}")
        return std
    return torch.full((n_u,), check_number("std", value, strict=True), dtype=torch.float64)
