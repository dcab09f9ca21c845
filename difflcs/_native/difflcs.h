/* difflcs without Python: a contact MPC that `difflcs export` has written, in C.
 *
 *     char error[256];
 *     difflcs_controller* controller = difflcs_load("controller.difflcs", error, sizeof error);
 *     if (!controller) { fprintf(stderr, "%s\n", error); return 1; }
 *     for (;;) {
 *       difflcs_status status = difflcs_step(controller, x, goal, u);   // u is always safe to read
 *       ...
 *     }
 *     difflcs_free(controller);
 *
 * All numbers are doubles in the units of the model. Loading and difflcs_reserve allocate all memory; nothing else
 * does. A step takes no lock and calls the operating system for the time alone. Two controllers are independent of each
 * other; one controller is for one thread at a time. No function throws or ends the process. */
#ifndef DIFFLCS_H
#define DIFFLCS_H

#include <stddef.h>

#if defined(_WIN32) && defined(DIFFLCS_SHARED)
#define DIFFLCS_API __declspec(dllimport)
#else
#define DIFFLCS_API
#endif

#ifdef __cplusplus
extern "C" {
#endif

typedef struct difflcs_controller difflcs_controller;

/* How a step ended; the codes are those of Python's `difflcs.Status`. */
typedef enum difflcs_status {
  DIFFLCS_CONVERGED = 0,  /* all optimality conditions hold */
  DIFFLCS_MAX_ITER = 1,   /* the iterations or the time were over */
  DIFFLCS_INFEASIBLE = 2, /* no plan that meets the hard constraints was found */
  DIFFLCS_NUMERICAL = 3,  /* the numbers broke down, or the state or the goal was not finite */
  DIFFLCS_DEGENERATE = 4, /* solved as well; it has no classical derivative there, which matters to learning alone */
  DIFFLCS_INVALID = -1    /* an argument was a null pointer, or the controller knows no goal; u was not written */
} difflcs_status;

/* The action of a step that is not solved (neither CONVERGED nor DEGENERATE). It is clipped into the bounds. */
typedef enum difflcs_fallback {
  DIFFLCS_HOLD = 0,  /* what the last solved plan has for this time, for at most H - 1 steps in a row; then zero */
  DIFFLCS_ZERO = 1,  /* zero */
  DIFFLCS_GIVEN = 2, /* the action that difflcs_set_fallback was given */
  DIFFLCS_UNFINISHED =
      3 /* that of the plan which the solver had reached, where the time or the iterations were over and
           it had one; else as HOLD. Such a plan obeys the model and the bounds, but may be poor. */
} difflcs_fallback;

typedef struct difflcs_sizes {
  size_t n_x;          /* states */
  size_t n_u;          /* actions */
  size_t n_lam;        /* contacts (complementarity variables) */
  size_t n_c;          /* constraints at each stage */
  size_t n_goal;       /* numbers of a goal; 0 where the cost has none */
  size_t horizon;      /* H */
  double step_seconds; /* time from one step to the next [s]; 0 where it is not known */
} difflcs_sizes;

typedef struct difflcs_outcome {
  difflcs_status status;
  int fallback;         /* 1: the action was the fallback */
  int late;             /* 1: the time limit stopped the solver */
  int iterations;       /* of the solver */
  double objective;     /* of the plan */
  double residual;      /* largest violation of the optimality conditions, without units */
  double solve_seconds; /* in the solver [s] */
} difflcs_outcome;

/* The last plan of the solver, also where it was not solved; valid until the next call with this controller. Row-major.
 */
typedef struct difflcs_plan {
  const double* x;   /* (H + 1, n_x) states */
  const double* u;   /* (H, n_u) actions */
  const double* lam; /* (H, n_lam) complementarity variables */
  const double* mu;  /* (H + 1, n_c) multipliers of the constraints */
} difflcs_plan;

/* States to plan from at once, and the system and the bounds of each, linearised there: row-major, and the same at all
 * stages. A pointer that is NULL stands for the controller's own numbers, for all states. */
typedef struct difflcs_batch {
  size_t count;                                /* states */
  const double* x;                             /* (count, n_x); never NULL */
  const double* goal;                          /* (n_goal) of all; NULL where n_goal is 0 */
  const double *A, *B, *C, *d, *D, *E, *F, *c; /* (count, n_x, n_x), (count, n_x, n_u) and so on */
  const double *u_min, *u_max;                 /* (count, n_u) */
} difflcs_batch;

/* Their plans; valid until the next call with this controller of difflcs_plan_many or difflcs_reserve. */
typedef struct difflcs_plans {
  const double* x;           /* (count, H + 1, n_x) states */
  const double* u;           /* (count, H, n_u) actions */
  const double* lam;         /* (count, H, n_lam) complementarity variables */
  const double* mu;          /* (count, H + 1, n_c) multipliers of the constraints */
  const double* objective;   /* (count) */
  const double* residual;    /* (count) as in difflcs_outcome */
  const signed char* status; /* (count) a difflcs_status each */
} difflcs_plans;

/* Loads a controller. Returns NULL where that fails, and writes why into `error`, if it is not NULL: at most `size`
 * bytes with the zero at the end. Files are checked in full (kind, version, size, checksum, every number). */
DIFFLCS_API difflcs_controller* difflcs_load(const char* path, char* error, size_t size);
/* The same from the bytes of such a file, which are copied. */
DIFFLCS_API difflcs_controller* difflcs_load_bytes(const void* bytes, size_t count, char* error, size_t size);
/* Frees it; NULL is allowed. */
DIFFLCS_API void difflcs_free(difflcs_controller* controller);

DIFFLCS_API difflcs_sizes difflcs_get_sizes(const difflcs_controller* controller);

/* Plans from the state x (n_x) to a goal (n_goal; NULL where n_goal is 0) and writes the action u (n_u): the first of
 * the plan, or the fallback. Begins at the plan of the last step, one step later. x, goal and u may lie anywhere. */
DIFFLCS_API difflcs_status difflcs_step(difflcs_controller* controller, const double* x, const double* goal, double* u);
/* The same along a reference (H + 1, n_goal): a goal for each state of the plan, the first for x. */
DIFFLCS_API difflcs_status difflcs_follow(difflcs_controller* controller, const double* x, const double* reference,
                                          double* u);
/* Plans from many states at once, as to compare places to push from. Each plan begins cold, with the starts that the
 * backend of the file has for that; it neither uses nor changes the plan that difflcs_step follows. The time limit
 * holds for the whole call. A plan that is not solved is finite and inside the bounds. Returns CONVERGED where all are
 * solved, else the status of the first that is not; DIFFLCS_INVALID, having planned nothing, where a number is not
 * finite, bounds cross, something is missing, or there is no memory for so many states: difflcs_reserve makes it. */
DIFFLCS_API difflcs_status difflcs_plan_many(difflcs_controller* controller, const difflcs_batch* batch,
                                             difflcs_plans* plans);
/* Makes memory for up to `count` states at once. Returns DIFFLCS_INVALID where that fails. */
DIFFLCS_API difflcs_status difflcs_reserve(difflcs_controller* controller, size_t count);
/* Forgets all plans, as at the begin of an episode. */
DIFFLCS_API void difflcs_reset(difflcs_controller* controller);

/* How the last step went; MAX_ITER and zeros before the first. */
DIFFLCS_API difflcs_outcome difflcs_get_outcome(const difflcs_controller* controller);
DIFFLCS_API difflcs_plan difflcs_get_plan(const difflcs_controller* controller);

/* Stops the solver so many seconds after a step began: at its next iteration, or in large problems (more than 16
 * contacts) at the next stage of one. 0 or less, or NaN: no limit, as at first. */
DIFFLCS_API void difflcs_set_time_limit(difflcs_controller* controller, double seconds);
/* Chooses the fallback, DIFFLCS_HOLD at first; `action` (n_u) is copied for DIFFLCS_GIVEN and else not looked at.
 * Returns DIFFLCS_INVALID, and changes nothing, where it is needed and is NULL or not finite, or the kind is another.
 */
DIFFLCS_API difflcs_status difflcs_set_fallback(difflcs_controller* controller, difflcs_fallback kind,
                                                const double* action);

/* Other numbers of the system, in the order A B C d D E F c, or of the cost, in the order Q R S Q_final q r q_final (Q,
 * R and Q_final symmetric): for a robot that linearises them anew before a step. Row-major, with the sizes of those in
 * the file, stages included, and copied; F + F^T must stay positive definite, and the cost convex. Returns
 * DIFFLCS_INVALID, and changes nothing, where one is NULL or not finite, or the cost has goals. Bounds of the actions
 * likewise, each u_min below its u_max. */
DIFFLCS_API difflcs_status difflcs_set_system(difflcs_controller* controller, const double* const matrices[8]);
DIFFLCS_API difflcs_status difflcs_set_cost(difflcs_controller* controller, const double* const terms[7]);
DIFFLCS_API difflcs_status difflcs_set_bounds(difflcs_controller* controller, const double* u_min, const double* u_max);

/* "CONVERGED" and so on. */
DIFFLCS_API const char* difflcs_status_name(difflcs_status status);
/* The instruction set in use: "baseline" or "avx2"; or that of the environment variable DIFFLCS_ISA, also "avx512".
 * "none" where it names one that this processor has not. */
DIFFLCS_API const char* difflcs_isa(void);

#ifdef __cplusplus
}
#endif

#endif
