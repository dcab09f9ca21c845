"""qpax: a differentiable interior-point method in JAX, for the dense program in the actions alone; n_lam = 0."""

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import qpax  # noqa: E402

from rivals.problem import Answer, Condensed, Problem, Rival  # noqa: E402


class Solver(Rival):
    """`solve_qp` for plans and `solve_qp_primal` for gradients, compiled, mapped over the batch."""

    packages = ("qpax", "jax")
    batches = differentiates = True

    def __init__(self, problem: Problem):
        super().__init__(problem)
        c = Condensed.of(problem)
        n, n_u = len(c.low), problem.n_u
        H, G, h = jnp.array(c.H), jnp.array(c.f[:, 1:]), jnp.array(c.f[:, 0])
        none, nothing = jnp.zeros((0, n)), jnp.zeros(0)
        box = jnp.concatenate([jnp.eye(n), -jnp.eye(n)]), jnp.concatenate([jnp.array(c.high), -jnp.array(c.low)])
        weight = jnp.array(problem.weight)

        def plan(x0):
            solution = qpax.solve_qp(H, G @ x0 + h, none, nothing, *box)
            return solution[0], solution[4]

        def action(x0):
            # kappa smooths the gradient; its default 1e-3 is much in units of these problems
            z = qpax.solve_qp_primal(H, G @ x0 + h, none, nothing, *box, solver_tol=1e-8, target_kappa=1e-8)
            return weight @ z[:n_u], z

        self.plan, self.many = jax.jit(plan), jax.jit(jax.vmap(plan))
        self.action = jax.jit(jax.vmap(jax.grad(action, has_aux=True)))
        self.x0 = jnp.array(problem.x0)

    def _answer(self, z, solved, gradient=None) -> Answer:
        u = np.asarray(z).reshape(-1, self.problem.horizon, self.problem.n_u)
        return Answer(u, np.atleast_1d(np.asarray(solved) == 1), gradient)

    def one(self, i: int) -> Answer:
        """Solve one problem in one call."""
        return self._answer(*self.plan(self.x0[i]))

    def all(self) -> Answer:
        """Solve all problems in one call."""
        return self._answer(*self.many(self.x0))

    def gradient(self) -> Answer:
        """Compute all plans and gradients in one call."""
        gradient, z = self.action(self.x0)
        return self._answer(z, np.ones(len(z), int), np.asarray(gradient))
