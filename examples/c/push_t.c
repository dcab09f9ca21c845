/* Push-T in C: the policy of examples/push_t.py, decision by decision, without Python:
 *
 *     python examples/push_t.py --export DIR
 *     push_t DIR observations.csv [--bench PASSES]
 *
 * The observations are a CSV file, with or without a line of names; a row has the number of its episode, x and y of the
 * disc [px], and x, y [px] and angle [rad] of the T. Where the number changes an episode begins. What is printed is a CSV
 * file again: what is done in each step, the place from which it pushes next where it travels, and the action, the
 * target of the disc [px]. With --bench, the steps of so many passes over the rows are timed instead.
 *
 * In each step the disc pushes, or it travels to a place from where a push is worth more (difflcs/planning/sampling.py
 * tells the method and its source). The names are those of Python. What never changes is in DIR: the problem of the MPC
 * with its cost, and numbers that Python has computed once, such as curves round the outline. */
#define _POSIX_C_SOURCE 199309L
#include <difflcs.h>
#include <math.h>
#include <time.h>

#include "common.h"

enum { PARTS = 2, CORNERS = 4, PLACES = 32, STATES = 1 + PLACES, WAYPOINTS = 56, INSTANTS = 10, CELLS = 160 };
/* Pose of the T, place and velocity of the disc; its target from there; numbers of a row. */
enum { N_X = 7, N_U = 2, COLUMNS = 6 };
/* Points of the way that are compared for the ends of two steps. */
enum { FIRST = 10, SECOND = 14 };
enum { IDLE = 3, MOST_BARRED = 64 };
static const double LEAST = 0.3, SPEED = 0.02, TOUCH = 1e3; /* as in difflcs/planning/travel.py */
static const double TURN = 6.283185307179586;

/* ---- Vectors in the plane ---- */

typedef struct vec {
  double x, y;
} vec;

static vec plus(vec a, vec b) { return (vec){a.x + b.x, a.y + b.y}; }
static vec minus(vec a, vec b) { return (vec){a.x - b.x, a.y - b.y}; }
static vec times(double s, vec a) { return (vec){s * a.x, s * a.y}; }
static double dot(vec a, vec b) { return a.x * b.x + a.y * b.y; }
static double norm(vec a) { return sqrt(dot(a, a)); }
static double clamp(double v, double low, double high) { return fmin(fmax(v, low), high); }
static vec clamp_all(vec v, double low, double high) { return (vec){clamp(v.x, low, high), clamp(v.y, low, high)}; }
static int is_within(vec v, double low, double high) { return v.x >= low && v.x <= high && v.y >= low && v.y <= high; }

/* Number i of n at equal distances from 0 to 1. */
static double part_of(long i, long n) {
  const double step = 1.0 / (double)(n - 1);
  return 2 * i < n ? step * (double)i : 1.0 - step * (double)(n - 1 - i);
}

/* A pose in the plane. */
typedef struct frame {
  vec at;
  double cos, sin;
} frame;

static frame frame_of(const double* pose) { return (frame){{pose[0], pose[1]}, cos(pose[2]), sin(pose[2])}; }
static vec turned(const frame* f, vec v) { return (vec){f->cos * v.x - f->sin * v.y, f->sin * v.x + f->cos * v.y}; }
static vec from_body(const frame* f, vec v) { return plus(turned(f, v), f->at); }
static vec to_body(const frame* f, vec v) {
  const vec d = minus(v, f->at);
  return (vec){f->cos * d.x + f->sin * d.y, f->cos * d.y - f->sin * d.x};
}

/* Place and velocity of the disc. */
typedef struct motion {
  vec place, velocity;
} motion;

static motion disc_of(const double* x) { return (motion){{x[3], x[4]}, {x[5], x[6]}}; }

/* ---- What Python has written ---- */

typedef struct setting {
  double pixels;               /* in a unit of length; all that follows is in these units, but for the goal */
  double goal[3];              /* pose of the T's origin [px, px, rad] */
  vec center;                  /* centre of its area from there */
  vec outline[PARTS][CORNERS]; /* counterclockwise, about this centre */
  vec center_of_mass;
  double gyration, compliance, radius; /* of the T; of its contacts; of the disc */
  double workspace[3];                 /* lower and upper end of x and of y; largest component of an action */
  double weights[2][3];                /* of the squares of the errors of the pose, in a stage and at the end */
  double keep, smallest_gain, switch_price, travel_price, patience; /* SamplingSettings */
  double reach, margin;                                             /* DiscPlaces */
  double step, clearance, tolerance;                                /* PlanarTravel */
  double A[INSTANTS][2][2], b[INSTANTS][2];                         /* of the drive, see Drive.course */
  vec places[PLACES], waypoints[WAYPOINTS];                         /* round the outline */
  double grid;                                                      /* half the side of the grid of distances */
} setting;

static int read_setting(const char* path, setting* s) {
  const struct {
    const char* name;
    void* to;
    size_t bytes;
  } entries[] = {
      {"pixels", &s->pixels, sizeof s->pixels},
      {"goal", &s->goal, sizeof s->goal},
      {"center", &s->center, sizeof s->center},
      {"outline", &s->outline, sizeof s->outline},
      {"center_of_mass", &s->center_of_mass, sizeof s->center_of_mass},
      {"gyration", &s->gyration, sizeof s->gyration},
      {"compliance", &s->compliance, sizeof s->compliance},
      {"radius", &s->radius, sizeof s->radius},
      {"workspace", &s->workspace, sizeof s->workspace},
      {"weights", &s->weights, sizeof s->weights},
      {"keep", &s->keep, sizeof s->keep},
      {"smallest_gain", &s->smallest_gain, sizeof s->smallest_gain},
      {"switch_price", &s->switch_price, sizeof s->switch_price},
      {"travel_price", &s->travel_price, sizeof s->travel_price},
      {"patience", &s->patience, sizeof s->patience},
      {"reach", &s->reach, sizeof s->reach},
      {"margin", &s->margin, sizeof s->margin},
      {"step", &s->step, sizeof s->step},
      {"clearance", &s->clearance, sizeof s->clearance},
      {"tolerance", &s->tolerance, sizeof s->tolerance},
      {"A", &s->A, sizeof s->A},
      {"b", &s->b, sizeof s->b},
      {"places", &s->places, sizeof s->places},
      {"waypoints", &s->waypoints, sizeof s->waypoints},
      {"grid", &s->grid, sizeof s->grid},
  };
  FILE* file = fopen(path, "r");
  if (!file) return fprintf(stderr, "%s: expected a file that can be read\n", path), 0;
  int right = 1;
  for (size_t i = 0; right && i < sizeof entries / sizeof *entries; i++) {
    const size_t count = entries[i].bytes / sizeof(double);
    char name[32] = "";
    right = fscanf(file, "%31s", name) == 1 && strcmp(name, entries[i].name) == 0;
    for (size_t j = 0; right && j < count; j++) right = fscanf(file, "%lf", (double*)entries[i].to + j) == 1;
    if (!right) fprintf(stderr, "%s: expected %zu numbers of %s, got %s\n", path, count, entries[i].name, name);
  }
  fclose(file);
  return right;
}

/* ---- The policy, with all its memory ---- */

typedef struct policy {
  setting set;
  difflcs_controller* mpc;
  size_t horizon;
  double distances[CELLS + 1][CELLS + 1]; /* to the outline, at points of a grid in coordinates of the T */
  double between[WAYPOINTS][WAYPOINTS];   /* lengths of the straight ways between waypoints, infinite where none is */

  /* From step to step. */
  vec velocity;                 /* of the disc, which is not observed but follows from the drive */
  int chosen, steps, pushed;    /* number of the place that it travels to, or 0; for how long; whether it pushed last */
  double stood, reference;      /* costs of standing still, by which it sees whether anything has changed */
  int idle, has_last, n_barred; /* pushes that have changed nothing; of what follows, whether there is one, how many */
  vec last, barred[MOST_BARRED]; /* the last place that it travelled to, and those that it goes to no more */

  /* The states that are compared: the first is that of the robot. Their systems, and bounds of their actions. */
  double x[STATES][N_X], C[STATES][N_X][PARTS], D[STATES][PARTS][N_X], E[STATES][PARTS][N_U], F[STATES][PARTS][PARTS];
  double c[STATES][PARTS], u_min[STATES][N_U], u_max[STATES][N_U], scores[STATES];
} policy;

/* As at the start of an episode. */
static void reset(policy* p) {
  p->velocity = (vec){0, 0};
  p->chosen = p->steps = p->pushed = p->idle = p->has_last = p->n_barred = 0;
  p->stood = p->reference = 0;
}

/* ---- The outline (difflcs/physics/shapes.py, difflcs/planning/outline.py) ---- */

typedef struct nearest {
  double distance; /* signed, negative inside */
  vec normal, point;
} nearest;

static nearest nearest_on(const vec* corners, vec at) {
  vec side = {0, 0}, to = {0, 0};
  double least = INFINITY;
  int inside = 0;
  for (int i = 0; i < CORNERS; i++) {
    const vec along = minus(corners[(i + 1) % CORNERS], corners[i]), from = minus(at, corners[i]);
    const double t = clamp(dot(from, along) / dot(along, along), 0, 1);
    const vec apart = minus(from, times(t, along));
    if (dot(apart, apart) < least) least = dot(apart, apart), side = along, to = from;
    /* A ray from the point crosses the sides an odd number of times if it is inside. */
    const int spans = (from.y < 0) != (at.y - corners[(i + 1) % CORNERS].y < 0);
    if (spans && from.x * fabs(along.y) < from.y * along.x * (along.y > 0 ? 1 : -1)) inside = !inside;
  }
  const double square = dot(side, side), along = dot(to, side) / square, sign = inside ? -1 : 1;
  const vec beyond = times(clamp(along, 0, 1), side), apart = minus(to, beyond);
  const vec outward = times(1 / sqrt(square), (vec){side.y, -side.x}), point = plus(minus(at, to), beyond);
  const double size = norm(apart);
  if ((along > 0 && along < 1) || size == 0) return (nearest){dot(apart, outward), outward, point};
  return (nearest){sign * size, times(sign / size, apart), point};
}

static double distance_to(const setting* s, vec at) {
  double least = INFINITY;
  for (int k = 0; k < PARTS; k++) least = fmin(least, nearest_on(s->outline[k], at).distance);
  return least;
}

static void fill_grid(policy* p) {
  const double half = p->set.grid;
  for (int i = 0; i <= CELLS; i++)
    for (int j = 0; j <= CELLS; j++) {
      const vec at = {half * (2 * part_of(i, CELLS + 1) - 1), half * (2 * part_of(j, CELLS + 1) - 1)};
      p->distances[i][j] = distance_to(&p->set, at);
    }
}

/* The gap of the disc at a point in coordinates of the T, interpolated on the grid. */
static double gap(const policy* p, vec at) {
  const double half = p->set.grid, cells = CELLS / (2 * half), most = CELLS * (1 - 1e-12);
  const double x = clamp((at.x + half) * cells, 0, most), y = clamp((at.y + half) * cells, 0, most);
  const int i = (int)x, j = (int)y;
  const double *low = p->distances[i] + j, *high = p->distances[i + 1] + j;
  const double left = low[0] + (y - j) * (low[1] - low[0]), right = high[0] + (y - j) * (high[1] - high[0]);
  return left + (x - i) * (right - left) - p->set.radius;
}

/* ---- Travel (difflcs/planning/travel.py) ---- */

/* Which of `count` ends the disc can go straight to from a point, in coordinates of the T. */
static void find_in_sight(const policy* p, vec start, const vec* ends, int count, int* seen) {
  double longest = 0;
  for (int i = 0; i < count; i++) longest = fmax(longest, norm(minus(ends[i], start)));
  const long samples = 2 + (long)ceil(longest / (0.5 * p->set.clearance + 0.1 * p->set.radius));
  for (int i = 0; i < count; i++) {
    const vec way = minus(ends[i], start);
    const double at_ends = fmin(gap(p, start), gap(p, plus(start, way)));
    const double least = fmin(at_ends, LEAST * p->set.clearance) - 1e-9;
    seen[i] = 1;
    for (long k = 1; seen[i] && k < samples - 1; k++)
      seen[i] = gap(p, plus(start, times(part_of(k, samples), way))) >= least;
  }
}

/* Lengths of the straight ways from a point to the waypoints. */
static void find_legs(const policy* p, vec from, double* lengths) {
  int seen[WAYPOINTS], any = 0, closest = 0;
  find_in_sight(p, from, p->set.waypoints, WAYPOINTS, seen);
  for (int i = 0; i < WAYPOINTS; i++) {
    lengths[i] = norm(minus(p->set.waypoints[i], from));
    any |= seen[i];
    if (lengths[i] < lengths[closest]) closest = i;
  }
  if (!any) seen[closest] = 1; /* as at a corner that points inwards: the nearest leads away from the T */
  for (int i = 0; i < WAYPOINTS; i++)
    if (!seen[i]) lengths[i] = INFINITY;
}

static void find_between(policy* p) {
  int seen[WAYPOINTS][WAYPOINTS];
  const vec* at = p->set.waypoints;
  for (int i = 0; i < WAYPOINTS; i++) find_in_sight(p, at[i], at, WAYPOINTS, seen[i]);
  for (int i = 0; i < WAYPOINTS; i++)
    for (int j = 0; j < WAYPOINTS; j++)
      p->between[i][j] = seen[i][j] && seen[j][i] ? norm(minus(at[i], at[j])) : INFINITY;
}

/* The shortest way from start to end by waypoints, in coordinates of the T. Returns the number of its points. */
static int find_way(const policy* p, const frame* body, vec start, vec end, vec* way) {
  int seen, before[WAYPOINTS], shorter = 1, best = 0, count = 2;
  double length[WAYPOINTS], next[WAYPOINTS], last[WAYPOINTS], outside[WAYPOINTS];
  way[0] = start, way[1] = end;
  find_in_sight(p, start, &end, 1, &seen);
  if (seen) return 2;
  find_legs(p, start, length);
  for (int i = 0; i < WAYPOINTS; i++) {
    const vec at = from_body(body, p->set.waypoints[i]);
    outside[i] = is_within(at, p->set.workspace[0], p->set.workspace[1]) ? 0 : TOUCH;
    length[i] += outside[i];
    before[i] = -1;
  }
  while (shorter) {
    int by[WAYPOINTS];
    shorter = 0;
    for (int j = 0; j < WAYPOINTS; j++) {
      next[j] = length[j], by[j] = before[j];
      double least = INFINITY;
      int from = -1;
      for (int i = 0; i < WAYPOINTS; i++) {
        const double through = length[i] + p->between[i][j] + outside[j];
        if (through < least) least = through, from = i;
      }
      if (least < length[j] - 1e-9) next[j] = least, by[j] = from, shorter = 1;
    }
    memcpy(length, next, sizeof length), memcpy(before, by, sizeof before);
  }
  find_legs(p, end, last);
  for (int i = 1; i < WAYPOINTS; i++)
    if (length[i] + last[i] < length[best] + last[best]) best = i;
  if (!isfinite(length[best] + last[best])) return 2;
  for (int i = best; i >= 0; i = before[i]) count++;
  way[count - 1] = end;
  for (int i = best, k = count - 2; i >= 0; i = before[i], k--) way[k] = p->set.waypoints[i];
  return count;
}

/* Points at equal distances along a way, at most so far; `at` is how far each is. */
static void place_along(const vec* way, int count, double longest, int points, double* at, vec* to) {
  double whole = 0, begun = 0;
  for (int i = 1; i < count; i++) whole += norm(minus(way[i], way[i - 1]));
  const double far = fmin(whole, longest), first = 1.0 / points;
  for (int k = 0, side = 0; k < points; k++) {
    at[k] = far * (first + (1 - first) * part_of(k, points));
    double length = norm(minus(way[side + 1], way[side]));
    while (side < count - 2 && begun + length < at[k]) {
      begun += length, side++;
      length = norm(minus(way[side + 1], way[side]));
    }
    const double part = (at[k] - begun) / fmax(length, 1e-12);
    to[k] = plus(way[side], times(part, minus(way[side + 1], way[side])));
  }
}

/* What comes of a step that is to end at a point: the action, the motion at the end, and by how much the gap on the way
 * is less than the least. */
typedef struct course {
  vec action;
  motion end;
  double touch;
} course;

static course steer(const policy* p, const frame* body, motion from, vec goal, double least) {
  const setting* s = &p->set;
  const double (*last)[2] = s->A[INSTANTS - 1];
  const vec drift = plus(times(last[0][0], from.place), times(last[0][1], from.velocity));
  vec u = times(1 / s->b[INSTANTS - 1][0], minus(goal, drift));
  u = times(s->step / fmax(norm(u), s->step), u);
  u = minus(clamp_all(plus(from.place, u), s->workspace[0], s->workspace[1]), from.place);
  course found = {u, from, 0};
  for (int t = 0; t < INSTANTS; t++) {
    const double (*A)[2] = s->A[t], *b = s->b[t];
    found.end.place = plus(plus(times(A[0][0], from.place), times(A[0][1], from.velocity)), times(b[0], u));
    found.end.velocity = plus(plus(times(A[1][0], from.place), times(A[1][1], from.velocity)), times(b[1], u));
    found.touch = fmax(found.touch, least - gap(p, to_body(body, found.end.place)));
  }
  return found;
}

/* The action of the disc on its way to a place. Of many points on the way, for the ends of this step and of the next,
 * it is sent to those that bring it farthest without touching the T. */
static vec travel(const policy* p, const frame* body, motion disc, vec there) {
  const vec start = to_body(body, disc.place), end = to_body(body, there);
  vec way[WAYPOINTS + 2], ends[FIRST], next_ends[SECOND], best = {0, 0};
  double at[FIRST], come[SECOND], highest = -INFINITY;
  const int count = find_way(p, body, start, end, way);
  for (int i = 0; i < count; i++) way[i] = from_body(body, way[i]);
  const double least = fmin(fmin(gap(p, start), gap(p, end)), LEAST * p->set.clearance);
  const double reach = p->set.b[INSTANTS - 1][0] * p->set.step;
  place_along(way, count, reach, FIRST, at, ends);
  place_along(way, count, 2 * reach, SECOND, come, next_ends);
  for (int i = 0; i < FIRST; i++) {
    const course first = steer(p, body, disc, ends[i], least);
    const int arrives = norm(minus(first.end.place, there)) < 0.6 * p->set.tolerance;
    for (int j = 0; j < SECOND; j++) {
      const course second = steer(p, body, first.end, next_ends[j], least);
      const double missed = norm(minus(second.end.place, next_ends[j])), speed = norm(second.end.velocity);
      const double score = come[j] - 2 * missed - SPEED * speed - TOUCH * (first.touch + second.touch) + 0.01 * at[i] +
                           10 * reach * arrives;
      if (score > highest) highest = score, best = first.action;
    }
  }
  return best;
}

static int is_near(const policy* p, vec a, vec b) { return norm(minus(a, b)) < p->set.tolerance; }

/* ---- The system (difflcs/physics/planar.py, complementarity.py) ---- */

/* Linearises contact at state i: a disc that a drive moves, and a body that moves by its mobility times the force. */
static void linearise(policy* p, int i) {
  const setting* s = &p->set;
  const double* x = p->x[i];
  const frame body = frame_of(x);
  const vec disc = {x[3], x[4]}, center = turned(&body, s->center_of_mass);
  const double turn[3] = {center.y, -center.x, 1}; /* of the origin, about the centre of mass */
  const double (*A)[2] = s->A[INSTANTS - 1], *b = s->b[INSTANTS - 1];
  double rows[PARTS][5]; /* derivatives of the gaps by the pose of the T and the place of the disc */
  memset(p->C[i], 0, sizeof p->C[i]);
  for (int k = 0; k < PARTS; k++) {
    const nearest near = nearest_on(s->outline[k], to_body(&body, disc));
    const vec n = turned(&body, near.normal), r = turned(&body, near.point);
    const double row[5] = {-n.x, -n.y, r.y * n.x - r.x * n.y, n.x, n.y};
    memcpy(rows[k], row, sizeof row);
    double along = 0;
    for (int m = 0; m < 3; m++) along += turn[m] * row[m];
    for (int m = 0; m < 3; m++) p->C[i][m][k] = (m < 2 ? row[m] : 0) + turn[m] * along / (s->gyration * s->gyration);
    const double D[N_X] = {row[0], row[1], row[2], A[0][0] * n.x, A[0][0] * n.y, A[0][1] * n.x, A[0][1] * n.y};
    memcpy(p->D[i][k], D, sizeof D);
    p->E[i][k][0] = b[0] * n.x, p->E[i][k][1] = b[0] * n.y;
    p->c[i][k] = fmax(near.distance - s->radius, 0); /* inside the outline counts as touching it */
    for (int m = 0; m < 5; m++) p->c[i][k] -= row[m] * x[m];
  }
  for (int k = 0; k < PARTS; k++)
    for (int l = 0; l < PARTS; l++) {
      p->F[i][k][l] = k == l ? s->compliance : 0;
      for (int m = 0; m < 3; m++) p->F[i][k][l] += 0.5 * (rows[k][m] * p->C[i][m][l] + rows[l][m] * p->C[i][m][k]);
    }
  for (int j = 0; j < N_U; j++) {
    p->u_min[i][j] = clamp(s->workspace[0] - x[3 + j], -s->workspace[2], 0);
    p->u_max[i][j] = clamp(s->workspace[1] - x[3 + j], 0, s->workspace[2]);
  }
}

/* ---- Decisions (difflcs/planning/sampling.py) ---- */

/* Whether the last pushes have changed the cost of standing still. */
static int is_moving(policy* p, double standing) {
  const int same = fabs(standing - p->stood) <= p->set.smallest_gain * p->stood;
  p->idle = p->pushed && same ? p->idle + 1 : 0;
  if (!same) p->stood = standing;
  return p->idle < IDLE;
}

/* Chooses the place to go to; 0 where none is worth the way. */
static int choose(policy* p, double standing) {
  if (fabs(standing - p->reference) > p->set.smallest_gain * p->reference)
    p->n_barred = 0, p->reference = standing;
  else if (p->has_last && p->n_barred < MOST_BARRED)
    p->barred[p->n_barred++] = p->last;
  for (;;) {
    int best = 1, barred = 0;
    for (int i = 2; i < STATES; i++)
      if (p->scores[i] > p->scores[best]) best = i;
    if (!(p->scores[best] > 0)) return p->n_barred = p->has_last = 0;
    for (int i = 0; i < p->n_barred; i++) barred |= is_near(p, p->barred[i], disc_of(p->x[best]).place);
    if (!barred) return best;
    p->scores[best] = -INFINITY;
  }
}

/* Plans from where the disc is and from all places. Writes the scores, gains less the price of the way, and the action
 * of the first plan; returns the cost of standing still. */
static double compare(policy* p, const frame* body, const double* goal, vec* action) {
  const setting* s = &p->set;
  int allowed[STATES] = {1};
  for (int i = 1; i < STATES; i++) {
    const vec place = from_body(body, s->places[i - 1]);
    const double x[N_X] = {p->x[0][0], p->x[0][1], p->x[0][2], place.x, place.y, 0, 0};
    memcpy(p->x[i], x, sizeof x);
    allowed[i] = is_within(place, s->workspace[0] + s->margin, s->workspace[1] - s->margin);
  }
  for (int i = 0; i < STATES; i++) linearise(p, i);
  const difflcs_batch batch = {.count = STATES,
                               .x = p->x[0],
                               .goal = goal,
                               .C = p->C[0][0], /* A, B and d are the same at all states: those of the file */
                               .D = p->D[0][0],
                               .E = p->E[0][0],
                               .F = p->F[0][0],
                               .c = p->c[0],
                               .u_min = p->u_min[0],
                               .u_max = p->u_max[0]};
  difflcs_plans plans = {0};
  *action = (vec){0, 0};
  for (int i = 0; i < STATES; i++) p->scores[i] = -INFINITY;
  if (difflcs_plan_many(p->mpc, &batch, &plans) == DIFFLCS_INVALID) return 0; /* it stands still */
  double standing = 0;
  for (int m = 0; m < 3; m++) {
    const double error = p->x[0][m] - goal[m];
    standing += ((double)p->horizon * s->weights[0][m] + s->weights[1][m]) * error * error;
  }
  for (int i = 0; i < STATES; i++) {
    const int solved = plans.status[i] == DIFFLCS_CONVERGED || plans.status[i] == DIFFLCS_DEGENERATE;
    const double way = norm(minus(disc_of(p->x[i]).place, disc_of(p->x[0]).place));
    const double price = i > 0 ? s->switch_price + s->travel_price * way : 0;
    if (allowed[i] && solved) p->scores[i] = standing - plans.objective[i] - standing * price;
  }
  *action = (vec){plans.u[0], plans.u[1]};
  return standing;
}

/* Chooses between a push from here and a journey. `stay`: one has just ended, and a push comes first. Returns the
 * action. */
static vec decide(policy* p, const frame* body, const double* goal, int stay) {
  const setting* s = &p->set;
  const motion disc = disc_of(p->x[0]);
  vec action;
  const double standing = compare(p, body, goal, &action), here = p->scores[0];
  double best = here;
  for (int i = 1; i < STATES; i++) best = fmax(best, p->scores[i]);
  const int pushes = here > s->smallest_gain * standing && here >= s->keep * best &&
                     distance_to(s, to_body(body, disc.place)) - s->radius < s->reach && is_moving(p, standing);
  p->chosen = stay || pushes ? 0 : choose(p, standing);
  p->pushed = !p->chosen;
  p->steps = 0;
  if (!p->chosen) return action;
  p->last = disc_of(p->x[p->chosen]).place;
  p->has_last = 1;
  return travel(p, body, disc, p->last);
}

/* Where the centre of the T's area is, from the pose of its origin [px, px, rad]. */
static vec center_of(const setting* s, const double* pose) {
  const frame origin = frame_of(pose);
  return plus(times(1 / s->pixels, origin.at), turned(&origin, s->center));
}

/* The target of the disc [px], from an observation. */
static vec act(policy* p, const double* observation) {
  const setting* s = &p->set;
  const vec disc = times(1 / s->pixels, (vec){observation[0], observation[1]});
  const vec here = center_of(s, &observation[2]), there = center_of(s, s->goal);
  const double yaw = observation[4], nearest_yaw = s->goal[2] + TURN * rint((yaw - s->goal[2]) / TURN);
  const double goal[3] = {there.x, there.y, nearest_yaw};
  const double x[N_X] = {here.x, here.y, yaw, disc.x, disc.y, p->velocity.x, p->velocity.y};
  memcpy(p->x[0], x, sizeof x);

  const frame body = frame_of(x);
  vec towards = {0, 0}, action;
  const int travels = p->chosen > 0;
  if (travels) towards = from_body(&body, s->places[p->chosen - 1]);
  if (travels && ++p->steps <= s->patience && !is_near(p, disc, towards))
    action = travel(p, &body, disc_of(x), towards);
  else
    action = decide(p, &body, goal, travels);

  const vec target = clamp_all(plus(disc, action), s->workspace[0], s->workspace[1]), sent = minus(target, disc);
  const double speed = s->A[INSTANTS - 1][1][1], push = s->b[INSTANTS - 1][1];
  p->velocity = plus(times(speed, p->velocity), times(push, sent));
  return times(s->pixels, target);
}

/* ---- The program ---- */

static policy* load(const char* folder) {
  char path[4096], error[256];
  policy* p = calloc(1, sizeof *p);
  if (!p) return NULL;
  snprintf(path, sizeof path, "%s/push_t.txt", folder);
  if (!read_setting(path, &p->set)) return NULL;
  snprintf(path, sizeof path, "%s/controller.difflcs", folder);
  p->mpc = difflcs_load(path, error, sizeof error);
  if (!p->mpc) return fprintf(stderr, "%s\n", error), NULL;
  const difflcs_sizes n = difflcs_get_sizes(p->mpc);
  if (n.n_x != N_X || n.n_u != N_U || n.n_lam != PARTS || n.n_goal != 3)
    return fprintf(stderr, "%s: expected the problem of Push-T, got another\n", path), NULL;
  p->horizon = n.horizon;
  if (difflcs_reserve(p->mpc, STATES) == DIFFLCS_INVALID) return fprintf(stderr, "not enough memory\n"), NULL;
  fill_grid(p);
  find_between(p);
  return p;
}

/* CPU time, as other programs may run on this core. */
static double now(void) {
  struct timespec at;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &at);
  return (double)at.tv_sec + 1e-9 * (double)at.tv_nsec;
}

int main(int argc, char** argv) {
  const int timed = argc == 5 && strcmp(argv[3], "--bench") == 0;
  const long passes = timed ? atol(argv[4]) : 1;
  if ((argc != 3 && !timed) || passes < 1) {
    fprintf(stderr, "usage: %s DIR observations.csv [--bench PASSES]\n", argv[0]);
    return 2;
  }
  double *rows = NULL, *seconds = NULL;
  policy* p = load(argv[1]);
  const long count = p ? read_rows(argv[2], COLUMNS, &rows) : -1;
  if (timed && count > 0) seconds = malloc((size_t)(passes * count) * sizeof(double));
  if (count < 1 || (timed && !seconds)) return 1;
  for (long i = 0; i < count * COLUMNS; i++)
    if (!isfinite(rows[i])) return fprintf(stderr, "%s: expected finite numbers\n", argv[2]), 1;

  if (!timed) printf("mode,place,x,y\n");
  for (long i = 0; i < passes * count; i++) {
    const double* row = rows + i % count * COLUMNS;
    if (i % count == 0 || row[0] != row[-COLUMNS]) reset(p);
    const double begun = now();
    const vec target = act(p, row + 1);
    if (timed)
      seconds[i] = now() - begun;
    else
      printf("%s,%d,%.17g,%.17g\n", p->chosen ? "travel" : "push", p->chosen, target.x, target.y);
  }
  if (timed) printf("%ld steps, %s\n", passes * count, difflcs_isa()), report("step", seconds, passes * count);
  free(seconds), free(rows);
  difflcs_free(p->mpc), free(p);
  return 0;
}
