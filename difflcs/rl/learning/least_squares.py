"""Mean-squares fits of small networks, several side by side, with gradients written by hand.

Of a step on networks this small, autograd and its bookkeeping take longer than the arithmetic: 2.5 times as long for an
ensemble of four with two hidden layers of 128, 4 times for a value network of 64.
"""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from difflcs.rl.learning.state_tree import StatefulAdam

Layer = tuple[Tensor, Tensor]
"""Weights (K, n_in, n_out) and biases (K, 1, n_out) of one layer of K networks."""


def tanh(x: Tensor) -> Tensor:
    """Hyperbolic tangent to 1e-7, in half of the time that torch takes for single precision."""
    return torch.sigmoid(2 * x).mul_(2).sub_(1)


BACKWARD: dict[Callable[[Tensor], Tensor], Callable[[Tensor, Tensor], Tensor]] = {
    torch.relu_: lambda gradient, value: torch.ops.aten.threshold_backward(gradient, value, 0),
    tanh: torch.ops.aten.tanh_backward,
}
"""Activation → function of the gradient with respect to its value, and of the value, that returns the gradient with
respect to its argument."""


def gradients(
    layers: Sequence[Layer], activation: Callable[[Tensor], Tensor], inputs: Tensor, targets: Tensor
) -> tuple[Tensor, list[Layer]]:
    """Mean squared errors of networks, and their gradients.

    Args:
        layers: from the first to the last, which has no activation.
        activation: a key of `BACKWARD`; it may work in place.
        inputs: (K, B, n_in).
        targets: (K, B, n_out).

    Returns:
        (K,) mean squared error of each network, and the gradients with respect to the layers' weights and biases.
    """
    values = [inputs]
    for weight, bias in layers[:-1]:
        values.append(activation(torch.baddbmm(bias, values[-1], weight)))
    errors = torch.baddbmm(layers[-1][1], values[-1], layers[-1][0]).sub_(targets)
    gradient = errors * (2 / math.prod(errors.shape[1:]))
    layer_gradients: list[Layer] = []
    for place in reversed(range(len(layers))):
        value = values[place]
        layer_gradients.append((torch.bmm(value.mT, gradient), gradient.sum(1, keepdim=True)))
        if place:
            gradient = BACKWARD[activation](torch.bmm(gradient, layers[place][0].mT), value)
    return errors.square_().mean((1, 2)), layer_gradients[::-1]


class FlatAdam(StatefulAdam):
    """AdamW on the parameters of a module, which become views of one vector: a step takes half the time of one on each.

    Args:
        module: the module to train.
        weight_decay: part of the parameters that a step of size one takes away.
    """

    def __init__(self, module: nn.Module, weight_decay: float):
        parameters = list(module.parameters())
        self.vector = nn.utils.parameters_to_vector(parameters).detach()
        for p, part in zip(parameters, self.vector.split([p.numel() for p in parameters]), strict=True):
            p.data = part.view_as(p)
        super().__init__([self.vector], 0.0, weight_decay, fused=True)

    def descend(self, gradient: Tensor, size: float) -> None:
        """Take a step of this size against the gradient (P,)."""
        self.vector.grad, self.param_groups[0]["lr"] = gradient, size
        self.step()
