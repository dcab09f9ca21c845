"""The global optimum with hard contact, λ·s = 0, by branch and bound over the modes with DAQP's quadratic programs."""

import heapq

import daqp
import numpy as np

from rivals.problem import Answer, Condensed, Problem, Rival, execute

FREE, NO_FORCE, CLOSED = 0, 1, 2
EQUALITY = 5  # DAQP's word for a constraint that holds with equality


class Solver(Rival):
    """Best-first branch and bound over which of λ and s is zero.

    The variables are all u and λ. A node's lower bound is the quadratic program with λ, s ≥ 0 where nothing is decided;
    its upper bound executes the node's actions. Branching decides the pair with the largest smaller part.

    Args:
        problem: what is to be solved; its relaxation plays no part.
        nodes: quadratic programs before it gives up.
        gap: relative distance of the bounds at which it has proved the optimum.
    """

    packages = ("daqp",)

    def __init__(self, problem: Problem, nodes: int = 20_000, gap: float = 1e-6):
        super().__init__(problem)
        self.nodes, self.gap = nodes, gap

    def one(self, i: int) -> Answer:
        """Find the best plan; return it, and whether it is proved to be the best of all."""
        data, p, c = self.problem.only(i), self.problem, Condensed.of(self.problem, i)
        at = c.at(data["x0"])
        H, f, constant, S, s0 = c.H, c.f @ at, float(at @ c.P @ at), c.S, c.s0 @ at
        size, contacts, forces, actions = len(f), len(s0), c.forces, c.actions
        # The forces have no cost: 1e-9 of the mean curvature makes their part positive definite.
        H[forces, forces] += 1e-9 * np.trace(H) / size
        low, high = np.concatenate([c.low, -s0]), np.concatenate([c.high, np.full(contacts, np.inf)])
        best, plan = np.inf, np.zeros((p.horizon, p.n_u))

        def bound(modes: np.ndarray) -> tuple[float, np.ndarray | None]:
            nonlocal best, plan
            above, sense = high.copy(), np.zeros(size + contacts, np.int32)
            above[forces[modes == NO_FORCE]] = 0.0
            above[size:][modes == CLOSED] = -s0[modes == CLOSED]
            sense[forces[modes == NO_FORCE]] = sense[size:][modes == CLOSED] = EQUALITY
            z, value, flag, _ = daqp.solve(H, f, S, above, low, sense, iter_limit=10_000)
            if flag < 1:
                return np.inf, None
            z = np.asarray(z)
            u = np.clip(z[actions].reshape(p.horizon, p.n_u), p.u_min, p.u_max)
            spent, end = execute(data, data["x0"], u)
            cost = spent + 0.5 * end @ data["Q_final"] @ end + data["q_final"] @ end
            if cost < best:
                best, plan = cost, u
            return value + constant, z

        root = np.zeros(contacts, np.int8)
        value, z = bound(root)
        heap, number = ([(value, 0, root, z)] if z is not None else []), 1
        while heap and number < self.nodes:
            value, _, modes, z = heapq.heappop(heap)
            if value >= best - self.gap * abs(best):
                heap = []
                break
            smaller = np.minimum(z[forces], S @ z + s0)
            smaller[modes != FREE] = -1.0
            pair = int(np.argmax(smaller))
            if smaller[pair] <= 1e-9:
                continue  # this node's plan is in contact as it must be: its value has become an upper bound
            for mode in (NO_FORCE, CLOSED):
                child = modes.copy()
                child[pair] = mode
                lower, point = bound(child)
                number += 1
                if point is not None and lower < best - self.gap * abs(best):
                    heapq.heappush(heap, (lower, number, child, point))
        return Answer(plan[None], np.array([not heap]))
