"""Argument checks shared by the whole library: expected, got, remedy."""

import difflib
import functools
import inspect
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, ParamSpec, TypeGuard, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves

from difflcs._differentiation import is_wrapped, transforms_active
from difflcs._native import _kernels  # pyright: ignore[reportMissingModuleSource]
from difflcs.errors import (
    DeviceError,
    DTypeError,
    InvalidInputError,
    NonFiniteError,
    NotPositiveDefiniteError,
    ShapeError,
)

P = ParamSpec("P")
R = TypeVar("R")

FLOATS = (torch.float32, torch.float64)
_REAL = {int, float, np.float32, np.float64, np.int32, np.int64}
_USABLE_DEVICES = ("cpu", "cuda", "mps", "xpu")


def describe(value: object) -> str:
    """Describe a value briefly for an error message."""
    if isinstance(value, Tensor):
        shape = "nested" if value.is_nested else str(tuple(value.shape))  # torch knows none of the former
        layout = "" if value.layout is torch.strided else f" {str(value.layout).removeprefix('torch.')}"
        return f"{shape}{layout} {str(value.dtype).removeprefix('torch.')} on {value.device}"
    if isinstance(value, np.ndarray) and value.ndim:
        return f"ndarray {value.shape} {value.dtype}"
    try:
        text = repr(value)
    except ValueError:  # Python writes no integers of more than 4300 digits
        text = "of many digits"
    return f"{type(value).__name__} {' '.join(text.split())}"[:120]


def describe_shapes(tensors: Mapping[str, Tensor]) -> str:
    """Describe tensors by name and shape for a repr, and the dtypes that are not float64: A(2, 2), d(2,)."""
    kinds = {str(value.dtype).removeprefix("torch.") for value in tensors.values()} - {"float64"}
    return ", ".join([*(f"{name}{tuple(value.shape)}" for name, value in tensors.items()), *sorted(kinds)])


def to_tensor(value: object) -> object:
    """Convert real numbers in a NumPy array or a list to a float64 tensor, a copy; anything else stays as it is."""
    if isinstance(value, list) and value and {type(leaf) for leaf in tree_leaves(value)} <= _REAL:
        with suppress(TypeError, ValueError, OverflowError):  # dictionaries, ragged rows, or an integer too large
            value = np.array(value, np.float64)
    if not isinstance(value, np.ndarray) or not value.ndim or value.dtype.kind not in "fiu":
        return value
    return torch.from_numpy(np.array(value, np.float64))


def check_array(name: str, value: object) -> np.ndarray:
    """Copy real numbers, also in a tensor or in lists, to a float64 array; NaN and infinity are allowed."""
    try:
        array = np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value)
    except (TypeError, ValueError, RuntimeError) as error:  # ragged, or a tensor without numbers
        raise DTypeError(f"{name}: expected numbers, got {describe(value)}; pass a NumPy array of floats") from error
    if array.dtype.kind not in "fiu":
        raise DTypeError(f"{name}: expected real numbers, got {describe(value)}; pass a NumPy array of floats")
    return np.array(array, np.float64)  # torch takes no others that are read-only or backwards


def takes_arrays(function: Callable[P, R]) -> Callable[P, R]:
    """Make a function of tensors take NumPy arrays and lists of numbers, too: see `to_tensor`."""

    @functools.wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        return function(*map(to_tensor, args), **{k: to_tensor(v) for k, v in kwargs.items()})  # pyright: ignore

    return wrapper


def did_you_mean(got: object, known: Iterable[str]) -> str:
    """Suggest the known names that somebody may have meant, in brackets for an error message; empty if none is near."""
    near = difflib.get_close_matches(str(got)[:100], known, n=2)
    return f" (did you mean {' or '.join(near)}?)" if near else ""


def check_tensor(name: str, value: object, dims: Sequence[tuple[str, int]] = (), finite: bool = True) -> Tensor:
    """Check one floating-point tensor of shape (..., *dims).

    Args:
        name: what to call it in the message.
        value: the candidate.
        dims: names and sizes of its trailing dimensions.
        finite: refuse NaN and infinity. Inside `torch.func` transforms numbers cannot be read: they are refused where
            they can, in the autograd function that works on them.

    Returns:
        The same tensor, unchanged.

    Raises:
        DTypeError: not a float32 or float64 tensor, or one that is not dense.
        DeviceError: on a device whose values cannot be read.
        ShapeError: wrong trailing dimensions.
        NonFiniteError: NaN or infinity inside.
    """
    if not isinstance(value, Tensor):
        raise DTypeError(
            f"{name}: expected a torch.Tensor, got {describe(value)}; wrap it with torch.as_tensor(...).double()"
        )
    if value.dtype not in FLOATS:
        raise DTypeError(f"{name}: expected float32 or float64, got {describe(value)}; convert it with {name}.double()")
    if value.layout is not torch.strided or value.is_nested or value.is_neg():  # see `is_array`
        how = "resolve_neg" if value.is_neg() else "to_padded_tensor" if value.is_nested else "to_dense"
        raise DTypeError(f"{name}: expected a dense tensor, got {describe(value)}; convert it with {name}.{how}(...)")
    if not value.is_cpu and value.device.type not in _USABLE_DEVICES:
        raise DeviceError(f"{name}: expected a tensor with data, got {describe(value)}; move it with {name}.to('cpu')")
    check_dims(name, value, dims)
    if finite and not is_wrapped(value) and not all_finite(value):
        bad = torch.nonzero(~torch.isfinite(value.detach()))
        raise NonFiniteError(
            f"{name}: expected finite numbers, got {len(bad)} NaN or infinite of {value.numel()}, "
            f"the first at index {tuple(bad[0].tolist())}; find where they come from before solving"
        )
    return value


def check_dims(name: str, value: Tensor, dims: Sequence[tuple[str, int]]) -> None:
    """Check the trailing dimensions of a tensor, as a part of `check_tensor`."""
    if dims and not _ends_in(value.shape, dims):
        labels = ", ".join(["..."] + [f"{label}={size}" for label, size in dims])
        unlike = len(dims) == 2 and dims[0][0] != dims[1][0]  # no square matrix
        turned = unlike and value.ndim > 1 and value.shape[-2] != dims[0][1] == value.shape[-1]
        how = "transpose it" if turned else "reshape it, or rebuild it"
        raise ShapeError(f"{name}: expected shape ({labels}), got {tuple(value.shape)}; {how}")


def check_shape(
    name: str, value: object, shape: str, sizes: Mapping[str, int | str] | None = None, remedy: str = "reshape it"
) -> Tensor:
    """Check one floating-point tensor and its shape, written as in docstrings: "... n_x", "n 2"; "5+" is 5 or more.

    `sizes` are those of names; a name that is not among them is any size.
    """
    tensor, batched = check_tensor(name, value), shape.startswith("...")
    words = shape.split()[batched:]
    dims = [sizes.get(word, word) for word in words] if sizes else words
    got = tensor.shape[max(tensor.ndim - len(dims), 0) :]
    fits = len(got) == (len(dims) if batched else tensor.ndim) == len(dims)
    for dim, size in zip(dims, got, strict=False):
        if isinstance(dim, str) and dim.endswith("+"):
            fits = fits and size >= int(dim[:-1])
        elif isinstance(dim, int) or not dim.isidentifier():
            fits = fits and size == int(dim)
    if not fits:
        labels = (word if dim == word else f"{word}={dim}" for word, dim in zip(words, dims, strict=True))
        wanted = "..., " * batched + ", ".join(labels) + "," * (len(dims) == 1 and not batched)
        raise ShapeError(f"{name}: expected shape ({wanted}), got {tuple(tensor.shape)}; {remedy}")
    return tensor


def takes(**shapes: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Make a method check the tensors that it takes, see `check_shape`, and get them in float64 on the CPU.

    Names of sizes are those of attributes, which may also say the least, as in "5+".
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        names = tuple(inspect.signature(function).parameters)

        def check(of: object, name: str, value: object) -> Tensor:
            sizes = {dim: size for dim in shapes[name].split() if (size := getattr(of, dim, None)) is not None}
            return check_shape(name, value, shapes[name], sizes).to("cpu", torch.float64)

        @functools.wraps(function)
        def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
            given = [check(args[0], name, v) if name in shapes else v for name, v in zip(names, args, strict=False)]
            named = {name: check(args[0], name, v) if name in shapes else v for name, v in kwargs.items()}
            return function(*given, *args[len(given) :], **named)  # pyright: ignore[reportCallIssue]

        return wrapper

    return decorate


def is_array(value: object) -> TypeGuard[Tensor]:
    """Return whether NumPy can read a value as it is: a dense tensor on the CPU."""
    return (
        isinstance(value, Tensor)
        and value.is_cpu
        and value.layout is torch.strided
        and not (value.is_nested or value.is_neg())
    )


def _ends_in(shape: torch.Size, dims: Sequence[tuple[str, int]]) -> bool:
    at = len(shape) - len(dims)
    if at < 0:
        return False
    for _, size in dims:
        if shape[at] != size:
            return False
        at += 1
    return True


def all_finite(*values: Tensor) -> bool:
    """Return whether no number of some tensors is NaN or infinite, in one call, as each call takes time."""
    if transforms_active() or not all([v.is_cpu for v in values]):
        return all(bool(torch.isfinite(v.detach()).all()) for v in values)
    return _kernels.all_finite([(v.detach() if v.requires_grad else v).numpy() for v in values])


def numbers_of(tensor: Tensor) -> int | None:
    """Return a number that says whether the numbers of a tensor have changed; None where they cannot be read."""
    if transforms_active() or is_wrapped(tensor):
        return None
    return _kernels.fingerprint(np.ascontiguousarray(tensor.detach().cpu().numpy()).reshape(-1).view(np.uint8))


def check_kind(name: str, value: object, kind: type[R] | tuple[type[R], ...], remedy: str = "") -> R:
    """Refuse anything but an object of a class, or of one of some classes."""
    if not isinstance(value, kind):
        wanted = " or ".join(one.__name__ for one in (kind if isinstance(kind, tuple) else (kind,)))
        remedy = remedy or ("give True or False" if kind is bool else "build one first")
        raise DTypeError(f"{name}: expected {wanted}, got {describe(value)}; {remedy}")
    return value


def check_list(name: str, value: Any, remedy: str, kind: Any = object) -> list[Any]:
    """Make a list of objects of a class; refuse a word, a tensor, and what cannot be counted up."""
    if isinstance(value, str | bytes | Tensor) or not isinstance(value, Iterable):
        raise DTypeError(f"{name}: expected a list, got {describe(value)}; {remedy}")
    return [check_kind(f"{name}[{i}]", one, kind, remedy) for i, one in enumerate(value)]


def check_finite(tensors: Mapping[str, Tensor]) -> None:
    """Refuse NaN and infinity in any of some tensors that `check_tensor` has accepted otherwise."""
    if any(map(is_wrapped, tensors.values())) or not all_finite(*tensors.values()):
        for name, value in tensors.items():
            check_tensor(name, value)


def check_positive_definite(F: Tensor) -> None:
    """Refuse F (..., n, n) whose symmetric part F + Fᵀ is not positive definite, where its numbers can be read."""
    if is_wrapped(F) or not F.numel():
        return
    symmetric = F.detach().double().cpu()
    symmetric = symmetric + symmetric.mT
    with suppress(np.linalg.LinAlgError):  # NumPy takes less time than torch for a single matrix
        np.linalg.cholesky(symmetric.numpy())
        return
    smallest = torch.linalg.eigvalsh(symmetric)[..., 0]
    where = f" at batch index {batch_index(smallest.shape, int(smallest.argmin()))}" if F.ndim > 2 else ""
    raise NotPositiveDefiniteError(
        f"F: expected F + Fᵀ positive definite, got smallest eigenvalue {float(smallest.min()):.3e}{where}; "
        f"add to the diagonal of F (LCSModel does it by `stiffness`)"
    )


def batch_index(shape: Sequence[int], flat: int) -> str:
    """Write a flat index as the index of a batch element: 3, or (1, 0)."""
    index = tuple(map(int, np.unravel_index(flat, shape)))
    return str(index[0]) if len(index) == 1 else str(index)


def check_same_device(tensors: Iterable[tuple[str, Tensor]]) -> None:
    """Refuse tensors on different devices, naming the first two that differ."""
    (first, like), *others = tensors
    for name, tensor in others:
        if tensor.device != like.device:
            where = f"on {like.device} like {first}, got {tensor.device}"
            raise DeviceError(f"{name}: expected it {where}; move one of them with .to(device)")


def plain(value: object) -> object:
    """Return the number in a NumPy scalar, or in an array or tensor without dimensions; anything else as it is.

    A tensor also stays as it is if it requires a gradient, which would be lost, or if its number cannot be read here.
    """
    if isinstance(value, Tensor):
        unread = value.layout is not torch.strided or value.is_nested or value.requires_grad or is_wrapped(value)
        return value if unread or value.ndim or value.device.type not in _USABLE_DEVICES else value.item()
    if isinstance(value, np.generic | np.ndarray) and not value.ndim:
        value = np.asarray(value)[()]
        return float(value) if isinstance(value, np.floating) else value.item()
    return value


def make_plain(settings: object) -> None:
    """Make the numbers among the fields of a frozen dataclass, and in their tuples, Python's; see `plain`."""
    for name, value in vars(settings).items():
        plain_value = tuple(map(plain, value)) if type(value) is tuple else plain(value)
        object.__setattr__(settings, name, plain_value)


def check_integer(name: str, value: object) -> int:
    """Check an integer of either sign, Python's or NumPy's."""
    value = int(value) if isinstance(value, np.integer) else value
    if isinstance(value, bool) or not isinstance(value, int):
        raise DTypeError(f"{name}: expected an int, got {describe(value)}; convert it with int(...)")
    return value


def check_positive_int(name: str, value: object, minimum: int = 1, maximum: int = 2**63 - 1) -> int:
    """Check an integer of at least `minimum` and at most `maximum`, by default the largest that torch takes."""
    value = check_integer(name, value)
    if value < minimum:
        raise InvalidInputError(f"{name}: expected at least {minimum}, got {_digits(value)}; pass a larger one")
    if value > maximum:
        raise InvalidInputError(f"{name}: expected at most {maximum}, got {_digits(value)}; pass a smaller one")
    return value


def _digits(value: int) -> str:
    return describe(value).removeprefix("int ")


def check_number(name: str, value: object, minimum: float = 0.0, strict: bool = False) -> float:
    """Check a finite real number (see `plain`), at least (`strict`: above) `minimum`."""
    value = plain(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        learned = isinstance(value, Tensor) and value.requires_grad
        how = (
            "pass matrices that are made of it, as a number has no gradient"
            if learned
            else "convert it with float(...)"
        )
        raise DTypeError(f"{name}: expected a number, got {describe(value)}; {how}")
    too_small = value <= minimum if strict else value < minimum
    try:
        number = float(value)
    except OverflowError:  # an integer that is too large
        number = math.inf
    if not math.isfinite(number) or too_small:
        relation = "above" if strict else "at least"
        got = repr(value) if isinstance(value, float) else _digits(value)
        raise InvalidInputError(f"{name}: expected a finite number {relation} {minimum:g}, got {got}; change it")
    return number


MAX_THREADS = 1024


def check_threads(value: int | None, name: str = "threads") -> None:
    """Check an optional number of threads or processes."""
    if value is not None:
        check_positive_int(name, value, maximum=MAX_THREADS)


def usable_cpus() -> int:
    """Count the CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_choice(name: str, value: object, choices: Sequence[str]) -> str:
    """Check one of a few words."""
    if not isinstance(value, str) or value not in choices:
        raise InvalidInputError(f"{name}: expected one of {', '.join(map(repr, choices))}, got {value!r:.200}")
    return value


def check_same_dtype(tensors: Mapping[str, Tensor]) -> None:
    """Refuse tensors of another dtype than the first of them."""
    (first, like), *others = tensors.items()
    for name, value in others:
        if value.dtype != like.dtype:
            how = f"convert it with {name}.to({like.dtype})"
            raise DTypeError(f"{name}: expected {like.dtype} like {first}, got {describe(value)}; {how}")


def broadcast_batch(shapes: Iterable[tuple[str, torch.Size]]) -> torch.Size:
    """Broadcast the leading batch shapes of several named ones; an error names one that does not fit."""
    result: tuple[int, ...] = ()
    named = list(shapes)
    for name, shape in named:
        wide = _broadcast(result, shape)
        if wide is None:
            listing = ", ".join(dict.fromkeys(f"{n} {tuple(s)}" for n, s in named if s))
            raise ShapeError(
                f"{name}: its batch dimensions {tuple(shape)} do not fit the others ({listing}); "
                f"expected equal batch dimensions, or none for a shared value"
            )
        result = wide
    return torch.Size(result)


def _broadcast(left: tuple[int, ...], right: tuple[int, ...]) -> tuple[int, ...] | None:
    """Broadcast two shapes, or return None; `torch.broadcast_shapes` costs 100 µs."""
    if left == right or not right:
        return left
    if len(left) < len(right):
        left, right = right, left
    kept = len(left) - len(right)
    pairs = list(zip(left[kept:], right, strict=True))
    if any(a != b and a != 1 and b != 1 for a, b in pairs):
        return None
    return (*left[:kept], *(b if a == 1 else a for a, b in pairs))
