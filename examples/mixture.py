"""A mixture of a few LCS, whose weights follow the state: `lcs-mixture`, a method to compare with `lcs-rl`.

    python examples/mixture.py train --method lcs-mixture --task banana --minutes 10 --seed 22 --out RUN
    python examples/mixture.py evaluate RUN

This is the command `difflcs` with the method that this file registers. One constant LCS has to be right everywhere, and
known physics has to be told. Between the two, the matrices at a state are averages

    M(x) = Σₖ wₖ(x) Mₖ,  w = softmax(W (x / scale) + b),  M one of A, B, C, d, D, E, F,

with Fₖ = Gₖ Gₖᵀ + stiffness I + Hₖ − Hₖᵀ as in `LCSModel`. An average of such F is one again, so the contact problem
keeps one solution. All of it is learned by the violation loss, and then by PPO through the MPC, which keeps the weights
of the present state through its horizon. What it reaches stands in docs/training.md, "A mixture of systems".
"""

import sys
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from difflcs import LCSModel, LCSParams, cli
from difflcs.errors import InvalidInputError
from difflcs.rl import register_method
from difflcs.rl.methods import LCSRLMethod

COMPONENTS = 2
"""Systems of a mixture."""
SCALE = (0.05, 0.05, 0.3, *[0.1] * 6)
"""What a state is divided by before the gate [m, rad]: place and yaw of the object, places of three fingertips."""


class MixtureLCS(LCSModel):
    """An `LCSModule` that averages a few systems, with weights of a linear gate on the state.

    Its parameters are those of an `LCSModel` with a first dimension of `COMPONENTS`, and the gate's `W` and `b`. The
    arguments are those of `LCSModel`; states have the nine numbers of the library's pushing tasks.
    """

    kind = "MixtureLCS"
    batched = True  # parameters may have batch dimensions, those of the states
    W: nn.Parameter
    b: nn.Parameter

    def __init__(self, *sizes, generator: torch.Generator | None = None, **options):
        super().__init__(*sizes, generator=generator, **options)
        if self.n_x != len(SCALE):
            raise InvalidInputError(f"n_x: expected the {len(SCALE)} states of a pushing task, got {self.n_x}")
        with torch.no_grad():
            self.W.normal_(std=0.67, generator=generator)
            self.b.zero_()

    @staticmethod
    def _shapes(x: int, u: int, m: int) -> dict[str, tuple[int, ...]]:
        systems = {name: (COMPONENTS, *shape) for name, shape in LCSModel._shapes(x, u, m).items()}
        return {**systems, "W": (COMPONENTS, x), "b": (COMPONENTS,)}

    def weights(self, x: Tensor) -> Tensor:
        """Compute the weights (..., COMPONENTS) of the systems at states (..., n_x)."""
        seen = (x / x.new_tensor(SCALE)).unsqueeze(-1)
        return ((self.W @ seen).squeeze(-1) + self.b).softmax(-1)

    def params(self, x: Tensor | None = None, context: Tensor | None = None) -> LCSParams:
        """Average the systems at states x (..., n_x), differentiable in them and in the parameters."""
        if x is None:
            raise InvalidInputError("x: expected the states of the system, got None; pass them")
        w = self.weights(x).unsqueeze(-1)
        vectors = {name: (w * getattr(self, name)).sum(-2) for name in ("d", "c")}
        matrices = {name: (w.unsqueeze(-1) * getattr(self, name)).sum(-3) for name in ("A", "B", "C", "D", "E", "F")}
        return LCSParams(**matrices, **vectors)


@register_method
@dataclass(frozen=True)
class MixtureMethod(LCSRLMethod):
    """LCS-RL with a mixture of two systems, told nothing of the object."""

    name: ClassVar[str] = "lcs-mixture"
    version: ClassVar[int] = 1
    summary: ClassVar[str] = "LCS-RL with a mixture of two systems (examples/mixture.py)"
    kind: ClassVar[str] = MixtureLCS.kind
    takes_init: ClassVar[bool] = False
    model: ClassVar[type[LCSModel]] = MixtureLCS


if __name__ == "__main__":
    sys.exit(cli.main(sys.argv[1:]))
