"""acados: optimal control in generated C with the solver HPIPM; n_lam = 0, where one step of SQP is the answer."""

import ctypes
import os
import sys
import tempfile

import acados
import numpy as np

os.environ["ACADOS_SOURCE_DIR"], os.environ["TERA_PATH"] = acados.DIR, acados.TERA_PATH
os.environ["ACADOS_PYTHON_INTERFACE_PATH"] = acados.TEMPLATE_DIR
sys.path.insert(0, os.path.dirname(acados.__file__))
for _name in ("libblasfeo.so", "libhpipm.so", "libqpOASES_e.so.3.1", "libacados.so"):  # the wheel sets no search path
    ctypes.CDLL(os.path.join(acados.LIB_DIR, _name), mode=ctypes.RTLD_GLOBAL)

import casadi  # noqa: E402
from acados_template import AcadosModel, AcadosOcp, AcadosOcpSolver  # noqa: E402

from rivals.problem import Answer, Problem, Rival  # noqa: E402


class Solver(Rival):
    """SQP_RTI with partial condensing and HPIPM."""

    packages = ("comma-deps-acados",)

    def __init__(self, problem: Problem):
        super().__init__(problem)
        p, ocp, model = problem, AcadosOcp(), AcadosModel()
        model.name = f"lin{abs(hash((p.A.tobytes(), p.horizon))) % 10**9}"
        model.x, model.u = casadi.SX.sym("x", p.n_x), casadi.SX.sym("u", p.n_u)
        model.disc_dyn_expr = casadi.mtimes(p.A, model.x) + casadi.mtimes(p.B, model.u) + p.d
        ocp.model = model
        ocp.dims.N = p.horizon
        weight = np.block([[p.Q, np.zeros((p.n_x, p.n_u))], [np.zeros((p.n_u, p.n_x)), p.R]])
        ocp.cost.cost_type, ocp.cost.cost_type_e = "EXTERNAL", "EXTERNAL"
        both = casadi.vertcat(model.x, model.u)
        model.cost_expr_ext_cost = casadi.bilin(weight, both) / 2 + casadi.dot(np.r_[p.q, p.r], both)
        model.cost_expr_ext_cost_e = casadi.bilin(p.Q_final, model.x) / 2 + casadi.dot(p.q_final, model.x)
        ocp.constraints.lbu, ocp.constraints.ubu = p.u_min, p.u_max
        ocp.constraints.idxbu, ocp.constraints.x0 = np.arange(p.n_u), p.x0[0]
        options = ocp.solver_options
        options.integrator_type, options.nlp_solver_type = "DISCRETE", "SQP_RTI"
        options.qp_solver = "PARTIAL_CONDENSING_HPIPM"
        options.hessian_approx, options.tf, options.print_level = "EXACT", float(p.horizon), 0
        options.qp_solver_iter_max, options.qp_tol = 200, 1e-8
        self.folder = tempfile.TemporaryDirectory()
        ocp.code_export_directory = f"{self.folder.name}/code"
        json_file = f"{self.folder.name}/ocp.json"
        self.solver = AcadosOcpSolver(ocp, json_file=json_file, verbose=False)

    def one(self, i: int) -> Answer:
        """Solve one QP."""
        solver, p = self.solver, self.problem
        for k in range(p.horizon):
            solver.set(k, "u", np.zeros(p.n_u))
            solver.set(k, "x", p.x0[i])
        solver.set(p.horizon, "x", p.x0[i])
        solver.set(0, "lbx", p.x0[i])
        solver.set(0, "ubx", p.x0[i])
        status = solver.solve()
        u = np.array([solver.get(k, "u") for k in range(p.horizon)])
        return Answer(u[None], np.array([status == 0]))
