"""Solvers of the MPC problem."""

from difflcs.mpc.backends.base import Backend, Result, available_backends, certify, get_backend, register_backend
from difflcs.mpc.backends.batched import BatchedBackend
from difflcs.mpc.backends.ipopt import IpoptBackend

register_backend(BatchedBackend)
register_backend(IpoptBackend)

__all__ = [
    "Backend",
    "BatchedBackend",
    "IpoptBackend",
    "Result",
    "available_backends",
    "certify",
    "get_backend",
    "register_backend",
]
