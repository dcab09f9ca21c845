/* Closes the loop with an exported controller on a recorded trajectory, and prints an action for each of its rows:
 *
 *     robot controller.difflcs trajectory.csv [--time-limit SECONDS] [--bench STEPS]
 *
 * The trajectory is a CSV file, with or without a line of names; each row has the n_x numbers of a state and the n_goal
 * numbers of the goal. What is printed is a CSV file again: the status of each step, and its action with all digits. With
 * --bench, so many steps over the rows of the trajectory, again and again, are timed instead. On a robot the states
 * come from its sensors and the actions go to its motors; the rest stays as it is here. */
#define _POSIX_C_SOURCE 199309L
#include "common.h"
#include <difflcs.h>
#include <time.h>

static double now(void) {
  struct timespec at;
  clock_gettime(CLOCK_MONOTONIC, &at);
  return (double)at.tv_sec + 1e-9 * (double)at.tv_nsec;
}

/* The time of `steps` steps over the rows, and how many were not solved. */
static int bench(difflcs_controller* controller, difflcs_sizes n, const double* rows, long count, long steps,
                 double* u) {
  double *whole = malloc((size_t)steps * sizeof(double)), *solver = malloc((size_t)steps * sizeof(double));
  long fallbacks = 0;
  if (!whole || !solver) return 1;
  for (long i = -count; i < steps; i++) { /* one pass to warm up */
    const double* row = rows + (size_t)((i + count) % count) * (n.n_x + n.n_goal);
    const double begun = now();
    difflcs_step(controller, row, row + n.n_x, u);
    const double seconds = now() - begun;
    const difflcs_outcome outcome = difflcs_get_outcome(controller);
    if (i < 0) continue;
    whole[i] = seconds, solver[i] = outcome.solve_seconds;
    fallbacks += outcome.fallback;
  }
  printf("%ld steps, %s, %ld fallbacks\n", steps, difflcs_isa(), fallbacks);
  report("step", whole, steps);
  report("of it the solver", solver, steps);
  free(whole), free(solver);
  return 0;
}

int main(int argc, char** argv) {
  char error[256];
  long steps = 0;
  double time_limit = 0, *rows = NULL;
  int usable = argc >= 3 && argc % 2 == 1;
  for (int i = 3; usable && i < argc; i += 2) {
    if (strcmp(argv[i], "--bench") == 0)
      usable = (steps = atol(argv[i + 1])) > 0;
    else if (strcmp(argv[i], "--time-limit") == 0)
      usable = (time_limit = atof(argv[i + 1])) > 0;
    else
      usable = 0;
  }
  if (!usable) {
    fprintf(stderr, "usage: %s controller.difflcs trajectory.csv [--time-limit SECONDS] [--bench STEPS]\n", argv[0]);
    return 2;
  }
  difflcs_controller* controller = difflcs_load(argv[1], error, sizeof error);
  if (!controller) {
    fprintf(stderr, "%s\n", error);
    return 1;
  }
  const difflcs_sizes n = difflcs_get_sizes(controller);
  difflcs_set_time_limit(controller, time_limit);
  const long count = read_rows(argv[2], n.n_x + n.n_goal, &rows);
  double* u = malloc(n.n_u * sizeof(double));
  if (count < 1 || !u) {
    fprintf(stderr, "%s: a row has %zu states and %zu numbers of a goal\n", argv[2], n.n_x, n.n_goal);
    return 1;
  }
  int code = 0;
  if (steps > 0) {
    code = bench(controller, n, rows, count, steps, u);
  } else {
    printf("status");
    for (size_t j = 0; j < n.n_u; j++) printf(",u%zu", j);
    printf("\n");
    for (long i = 0; i < count; i++) {
      const double* row = rows + (size_t)i * (n.n_x + n.n_goal);
      printf("%s", difflcs_status_name(difflcs_step(controller, row, row + n.n_x, u)));
      for (size_t j = 0; j < n.n_u; j++) printf(",%.17g", u[j]);
      printf("\n");
    }
  }
  free(u), free(rows);
  difflcs_free(controller);
  return code;
}
