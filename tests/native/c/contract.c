/* Checks of difflcs.h that need C: arguments that are null, no allocation after loading, two controllers at once, a
 * controller under deadlines, and plans from many states at once. With a second argument, a robot of changing numbers.
 * Usage: contract controller.difflcs [changes]; ends with 0 if all holds. */
#include <difflcs.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static int failures = 0;
#define EXPECT(what) ((what) ? (void)0 : (void)(failures++, printf("line %d: expected %s\n", __LINE__, #what)))

/* In glibc these take the place of its own, in the whole process; operator new comes here too. */
static long allocations = 0;
#ifdef __GLIBC__
extern void *__libc_malloc(size_t), *__libc_calloc(size_t, size_t), *__libc_realloc(void*, size_t);
extern void* __libc_memalign(size_t, size_t);
extern void __libc_free(void*);
void* malloc(size_t n) { return allocations++, __libc_malloc(n); }
void* calloc(size_t n, size_t size) { return allocations++, __libc_calloc(n, size); }
void* realloc(void* p, size_t n) { return allocations++, __libc_realloc(p, n); }
void* aligned_alloc(size_t to, size_t n) { return allocations++, __libc_memalign(to, n); }
void* memalign(size_t to, size_t n) { return allocations++, __libc_memalign(to, n); }
int posix_memalign(void** p, size_t to, size_t n) { return allocations++, !(*p = __libc_memalign(to, n)); }
void free(void* p) { allocations += p != NULL, __libc_free(p); }
#endif

static double state[64], goal[64], reference[64 * 64], action[64], other[64], ignored[64], given[64];

static void null_pointers(const char* path) {
  char error[64];
  EXPECT(!difflcs_load(NULL, error, sizeof error) && strstr(error, "expected"));
  EXPECT(!difflcs_load("no/such.file", error, sizeof error) && strstr(error, "no/such.file"));
  EXPECT(!difflcs_load("no/such.file", NULL, 0));
  EXPECT(!difflcs_load("no/such.file", error, 4) && strlen(error) == 3);
  EXPECT(!difflcs_load_bytes(NULL, 5, error, sizeof error));
  EXPECT(!difflcs_load_bytes("short", 5, error, sizeof error) && strstr(error, "5 bytes"));
  difflcs_free(NULL), difflcs_reset(NULL), difflcs_set_time_limit(NULL, 1);
  EXPECT(difflcs_step(NULL, state, goal, action) == DIFFLCS_INVALID);
  EXPECT(difflcs_get_sizes(NULL).n_x == 0 && difflcs_get_plan(NULL).x == NULL);
  EXPECT(difflcs_get_outcome(NULL).status == DIFFLCS_INVALID);
  difflcs_controller* c = difflcs_load(path, error, sizeof error);
  EXPECT(c != NULL);
  if (!c) return;
  EXPECT(difflcs_step(c, NULL, goal, action) == DIFFLCS_INVALID);
  EXPECT(difflcs_get_sizes(c).n_goal == 0 || difflcs_step(c, state, NULL, action) == DIFFLCS_INVALID);
  EXPECT(difflcs_step(c, state, goal, NULL) == DIFFLCS_INVALID);
  EXPECT(difflcs_follow(c, state, NULL, action) == DIFFLCS_INVALID);
  EXPECT(difflcs_set_fallback(c, DIFFLCS_GIVEN, NULL) == DIFFLCS_INVALID);
  EXPECT(difflcs_set_fallback(c, (difflcs_fallback)7, given) == DIFFLCS_INVALID);
  EXPECT(strcmp(difflcs_status_name((difflcs_status)99), "unknown") == 0);
  difflcs_free(c);
}

/* A system that stays where it is, whatever is done: the best action is none. Matrices that do not fit change nothing.
 */
static void other_system(difflcs_controller* c, difflcs_sizes n) {
  static double zeros[64 * 64], eye_x[64 * 64], eye_lam[64 * 64], ones[64];
  const double* matrices[8] = {eye_x, zeros, zeros, zeros, zeros, zeros, eye_lam, ones};
  for (size_t i = 0; i < n.n_x; i++) eye_x[i * n.n_x + i] = 1;
  for (size_t i = 0; i < n.n_lam; i++) eye_lam[i * n.n_lam + i] = ones[i] = 1;
  EXPECT(difflcs_set_system(c, matrices) == DIFFLCS_CONVERGED);
  const long before = allocations;
  EXPECT(difflcs_set_system(c, matrices) == DIFFLCS_CONVERGED);
  EXPECT(difflcs_step(c, state, goal, action) == DIFFLCS_CONVERGED && allocations == before);
  for (size_t j = 0; j < n.n_u; j++) EXPECT(fabs(action[j]) < 1e-6);
  ones[0] = NAN;
  EXPECT(difflcs_set_system(c, matrices) == DIFFLCS_INVALID);
  matrices[3] = NULL;
  EXPECT(difflcs_set_system(c, matrices) == DIFFLCS_INVALID && difflcs_set_system(NULL, matrices) == DIFFLCS_INVALID);
  EXPECT(n.n_goal == 0 || difflcs_set_cost(c, matrices) == DIFFLCS_INVALID);
  EXPECT(difflcs_step(c, state, goal, action) == DIFFLCS_CONVERGED);
}

enum { MANY = 5 };

/* Plans of a batch are those that each state gets alone, cold, with the system and the bounds of the batch. */
static void same_alone(difflcs_controller* c, const difflcs_batch* batch, const difflcs_plans* plans, difflcs_sizes n) {
  const size_t nx = n.n_x, nu = n.n_u, nl = n.n_lam, x = (n.horizon + 1) * nx, u = n.horizon * nu, lam = n.horizon * nl;
  for (size_t i = 0; i < batch->count; i++) {
    if (batch->A) {
      const double* system[8] = {batch->A + i * nx * nx, batch->B + i * nx * nu, batch->C + i * nx * nl,
                                 batch->d + i * nx,      batch->D + i * nl * nx, batch->E + i * nl * nu,
                                 batch->F + i * nl * nl, batch->c + i * nl};
      EXPECT(difflcs_set_system(c, system) == DIFFLCS_CONVERGED);
      EXPECT(difflcs_set_bounds(c, batch->u_min + i * nu, batch->u_max + i * nu) == DIFFLCS_CONVERGED);
    }
    difflcs_reset(c);
    EXPECT(difflcs_step(c, batch->x + i * nx, batch->goal, action) == (difflcs_status)plans->status[i]);
    EXPECT(memcmp(difflcs_get_plan(c).x, plans->x + i * x, x * sizeof(double)) == 0);
    EXPECT(memcmp(difflcs_get_plan(c).u, plans->u + i * u, u * sizeof(double)) == 0);
    EXPECT(memcmp(difflcs_get_plan(c).lam, plans->lam + i * lam, lam * sizeof(double)) == 0);
    EXPECT(difflcs_get_outcome(c).objective == plans->objective[i]);
    EXPECT(difflcs_get_outcome(c).residual == plans->residual[i]);
  }
}

static void many_at_once(difflcs_controller* c, difflcs_sizes n) {
  static double x[MANY * 64], A[MANY * 64 * 64], some[MANY * 64 * 64], F[MANY * 64 * 64], low[MANY * 64],
      high[MANY * 64];
  difflcs_batch batch = {.count = MANY, .x = x, .goal = goal};
  difflcs_plans plans;
  for (size_t i = 0; i < MANY * n.n_x; i++) x[i] = 0.02 * sin(0.7 * (double)i);
  EXPECT(difflcs_plan_many(c, &batch, &plans) == DIFFLCS_INVALID); /* nothing is reserved */
  EXPECT(difflcs_reserve(NULL, 1) == DIFFLCS_INVALID && difflcs_reserve(c, 0) == DIFFLCS_INVALID);
  EXPECT(difflcs_reserve(c, (size_t)-1) == DIFFLCS_INVALID && difflcs_reserve(c, MANY) == DIFFLCS_CONVERGED);
  const long before = allocations;
  EXPECT(difflcs_plan_many(c, &batch, &plans) == DIFFLCS_CONVERGED);
  same_alone(c, &batch, &plans, n);
  batch.count = MANY - 2;
  EXPECT(difflcs_plan_many(c, &batch, &plans) == DIFFLCS_CONVERGED);
  same_alone(c, &batch, &plans, n);

  difflcs_set_time_limit(c, 1e-9);
  EXPECT(difflcs_plan_many(c, &batch, &plans) == DIFFLCS_MAX_ITER);
  for (size_t i = 0; i < batch.count * n.horizon * n.n_u; i++) EXPECT(isfinite(plans.u[i]));
  difflcs_set_time_limit(c, 0);

  /* A system and bounds of its own for each state. */
  for (size_t i = 0; i < MANY * n.n_x * n.n_x; i++) A[i] = i % (n.n_x * n.n_x) % (n.n_x + 1) == 0;
  for (size_t i = 0; i < MANY * n.n_lam * n.n_lam; i++) F[i] = i % (n.n_lam * n.n_lam) % (n.n_lam + 1) == 0;
  for (size_t i = 0; i < MANY * 64 * 64; i++) some[i] = 0.3 * sin(1.3 * (double)i);
  for (size_t i = 0; i < MANY * n.n_u; i++) low[i] = -0.01 - 0.001 * (double)(i % 3), high[i] = 0.01;
  batch.A = A, batch.F = F, batch.u_min = low, batch.u_max = high;
  batch.B = some, batch.C = some + 1, batch.d = x, batch.D = some + 2, batch.E = some + 3, batch.c = some + 4;
  difflcs_plan_many(c, &batch, &plans);
  same_alone(c, &batch, &plans, n);
  EXPECT(allocations == before);

  batch.u_min = high, batch.u_max = low;
  EXPECT(difflcs_plan_many(c, &batch, &plans) == DIFFLCS_INVALID);
  batch.u_min = batch.u_max = NULL, batch.count = MANY + 1;
  EXPECT(difflcs_plan_many(c, &batch, &plans) == DIFFLCS_INVALID);
  batch.count = MANY, F[0] = NAN;
  EXPECT(difflcs_plan_many(c, &batch, &plans) == DIFFLCS_INVALID);
  batch.F = batch.x = NULL;
  EXPECT(difflcs_plan_many(c, &batch, &plans) == DIFFLCS_INVALID &&
         difflcs_plan_many(c, NULL, &plans) == DIFFLCS_INVALID);
  EXPECT(difflcs_plan_many(NULL, &batch, &plans) == DIFFLCS_INVALID);
}

/* A circle of all that one can ask of a loaded controller. */
static void circle(difflcs_controller* c, difflcs_sizes n, int times) {
  for (int i = 0; i < times; i++) {
    for (size_t j = 0; j < n.n_x; j++) state[j] = 0.02 * sin(0.3 * i + (double)j);
    difflcs_set_time_limit(c, i % 7 == 3 ? 1e-9 : 0);
    difflcs_step(c, state, goal, ignored);
    difflcs_follow(c, state, reference, ignored);
    if (i % 5 == 4) state[0] = NAN, difflcs_step(c, state, goal, ignored);
    difflcs_set_fallback(c, (difflcs_fallback)(i % 3), given);
    if (i % 11 == 10) difflcs_reset(c);
    difflcs_get_outcome(c), difflcs_get_plan(c), difflcs_get_sizes(c), difflcs_isa();
  }
}

static void no_allocation(difflcs_controller* c, difflcs_sizes n) {
  circle(c, n, 1); /* the C library's clock may set itself up */
  const long before = allocations;
#ifdef __GLIBC__
  EXPECT(before > 0);
#endif
  circle(c, n, 77); /* all that depends on the number of a step, once with each other */
  EXPECT(allocations == before);
}

static void deadline_and_fallback(difflcs_controller* c, difflcs_sizes n) {
  difflcs_reset(c), memset(state, 0, sizeof state);
  difflcs_set_fallback(c, DIFFLCS_GIVEN, given);
  difflcs_set_time_limit(c, 1e-9);
  EXPECT(difflcs_step(c, state, goal, action) == DIFFLCS_MAX_ITER);
  EXPECT(difflcs_get_outcome(c).late == 1 && difflcs_get_outcome(c).fallback == 1);
  for (size_t j = 0; j < n.n_u; j++) EXPECT(action[j] == given[j]);
  difflcs_set_time_limit(c, 0), difflcs_set_fallback(c, DIFFLCS_HOLD, NULL), difflcs_reset(c);
  EXPECT(difflcs_step(c, state, goal, action) == DIFFLCS_CONVERGED);
  EXPECT(difflcs_get_outcome(c).late == 0 && difflcs_get_outcome(c).fallback == 0);
  memcpy(other, difflcs_get_plan(c).u + n.n_u, n.n_u * sizeof(double));
  state[0] = NAN;
  EXPECT(difflcs_step(c, state, goal, action) == DIFFLCS_NUMERICAL);
  EXPECT(memcmp(action, other, n.n_u * sizeof(double)) == 0);
  state[0] = 0;
}

static void ten_steps(difflcs_controller* c, difflcs_controller* disturbing, difflcs_sizes n, double* u) {
  difflcs_set_time_limit(c, 0), difflcs_reset(c);
  for (int i = 0; i < 10; i++) {
    memset(state, 0, sizeof state), state[1] = 0.01 * i;
    difflcs_step(c, state, goal, u);
    if (disturbing) circle(disturbing, n, 2);
  }
}

/* Two controllers of one file: steps of one are none of the other. And a reset forgets all. */
static void independent(const char* path, difflcs_controller* first, difflcs_sizes n) {
  difflcs_controller* second = difflcs_load(path, NULL, 0);
  EXPECT(second != NULL);
  if (!second) return;
  ten_steps(first, second, n, action);
  ten_steps(second, NULL, n, other);
  EXPECT(memcmp(action, other, n.n_u * sizeof(double)) == 0);
  other_system(second, n);
  difflcs_free(second);
}

/* A robot that linearises itself before each step. The file has for each of them the doubles of the system, of the
 * cost, of the bounds, of the state, and of the action of Python's controller. A step that is late takes the next
 * action of the last plan. */
static void changes(difflcs_controller* c, difflcs_sizes n, const char* path) {
  const size_t x = n.n_x, u = n.n_u, l = n.n_lam;
  const size_t counts[19] = {x * x, x * u, x * l, x, l * x, l * u, l * l, l, x * x, u * u,
                             x * u, x * x, x,     u, x,     u,     u,     x, u};
  size_t starts[20] = {0};
  for (int i = 0; i < 19; i++) starts[i + 1] = starts[i] + counts[i];
  double* numbers = malloc(starts[19] * sizeof(double));
  const double* fields[19];
  for (int i = 0; i < 19; i++) fields[i] = numbers + starts[i];
  FILE* file = fopen(path, "rb");
  int steps = 0;
  while (file && numbers && fread(numbers, sizeof(double), starts[19], file) == starts[19]) {
    const long before = allocations;
    difflcs_set_time_limit(c, 0);
    EXPECT(difflcs_set_system(c, fields) == DIFFLCS_CONVERGED && difflcs_set_cost(c, fields + 8) == DIFFLCS_CONVERGED);
    EXPECT(difflcs_set_bounds(c, fields[15], fields[16]) == DIFFLCS_CONVERGED);
    const difflcs_status status = difflcs_step(c, fields[17], NULL, action);
    EXPECT(status == DIFFLCS_CONVERGED || status == DIFFLCS_DEGENERATE);
    EXPECT(allocations == before);
    for (size_t j = 0; j < u; j++) EXPECT(fabs(action[j] - fields[18][j]) < 1e-6);
    steps++;
  }
  memcpy(other, difflcs_get_plan(c).u + u, u * sizeof(double));
  const long before = allocations;
  difflcs_set_time_limit(c, 1e-9);
  EXPECT(difflcs_step(c, fields[17], NULL, action) == DIFFLCS_MAX_ITER && difflcs_get_outcome(c).late == 1);
  EXPECT(memcmp(action, other, u * sizeof(double)) == 0 && allocations == before);
  EXPECT(steps > 1);
  EXPECT(difflcs_set_bounds(c, fields[16], fields[15]) == DIFFLCS_INVALID); /* the larger one first */
  EXPECT(difflcs_set_bounds(NULL, fields[15], fields[16]) == DIFFLCS_INVALID);
  EXPECT(difflcs_set_bounds(c, fields[15], NULL) == DIFFLCS_INVALID && difflcs_set_cost(c, NULL) == DIFFLCS_INVALID);
  if (file) fclose(file);
  free(numbers);
}

int main(int argc, char** argv) {
  char error[256];
  if (argc < 2 || argc > 3) return 2;
  null_pointers(argv[1]);
  difflcs_controller* c = difflcs_load(argv[1], error, sizeof error);
  if (!c) return printf("%s\n", error), 1;
  const difflcs_sizes n = difflcs_get_sizes(c);
  if (n.n_x > 64 || n.n_u > 64 || n.n_goal > 64 || n.horizon > 63) return 2;
  if (argc == 3) {
    changes(c, n, argv[2]);
    difflcs_free(c);
    printf(failures ? "%d failures\n" : "all holds\n", failures);
    return failures != 0;
  }
  for (size_t j = 0; j < n.n_goal; j++) goal[j] = 0.05 / (double)(j + 1);
  for (size_t k = 0; k <= n.horizon; k++) memcpy(reference + k * n.n_goal, goal, n.n_goal * sizeof(double));
  for (size_t j = 0; j < n.n_u; j++) given[j] = 0.001 * (double)j;
  no_allocation(c, n);
  deadline_and_fallback(c, n);
  independent(argv[1], c, n);
  many_at_once(c, n);
  difflcs_free(c);
  printf(failures ? "%d failures\n" : "all holds\n", failures);
  return failures != 0;
}
