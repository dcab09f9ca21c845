"""Solvers of the MPC problem."""

from difflcs.mpc.backends.base import Backend, Result, available_backends, certify, get_backend, register_backend
from difflcs.mpc.backends.batched import BatchedBackend
from difflcs.mpc.backends.ipopt import IpoptBackend
from difflcs.mpc.backends.relaxed import RelaxedBackend

register_backend(BatchedBackend)
register_backend(IpoptBackend)
register_backend(RelaxedBackend)

__all__ = [
    "Backend",
    "BatchedBackend",
    "IpoptBackend",
    "RelaxedBackend",
    "Result",
    "available_backends",
    "certify",
    "get_backend",
    "register_backend",
]
