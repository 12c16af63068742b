/* What both versions of FMI share: an instance of the model and what happens to it.

   All variables stand in one array. A value reference is a place in it:
   time, states, derivatives, controls, disturbances, field, parameters, step, outputs.
   The last state is the azimuth where blades pass. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define API __declspec(dllexport)
#else
#define API __attribute__((visibility("default")))
#endif

/* A version of FMI defines FMI(name), which puts its prefix before a name, and told(), which hands
   an error on. The first word of every function, and its last one: a problem in words, or NULL. */
#define SELF Instance *m = (Instance *)c; if (!m) return FMI(Error)
#define ANSWER(problem) \
  const char *text = (problem); \
  return text ? told(m, FMI(Error), text) : FMI(OK)

enum {
  AT_STATES = 1,
  AT_RATES = AT_STATES + COUNT_STATES,
  AT_INPUTS = AT_RATES + COUNT_STATES,
  COUNT_INPUTS = COUNT_CONTROLS + COUNT_DISTURBANCES + COUNT_FIELD,
  AT_FIELD = AT_INPUTS + COUNT_CONTROLS + COUNT_DISTURBANCES,
  AT_PARAMETERS = AT_INPUTS + COUNT_INPUTS,
  AT_STEP = AT_PARAMETERS + COUNT_PARAMETERS,
  AT_OUTPUTS = AT_STEP + 1,
  COUNT_ALL = AT_OUTPUTS + COUNT_OUTPUTS
};

typedef struct {
  double value[COUNT_ALL];
  double slope[COUNT_INPUTS + 1]; /* of the inputs per second within a step, FMI 2 only */
  int stale; /* whether derivatives and outputs are to be computed */
} State;

typedef struct {
  State now;
  char name[256];
  void *environment;
  void *logger;
  int logging;
} Instance;

static void instance_reset(Instance *m) {
  memset(&m->now, 0, sizeof m->now);
  memcpy(m->now.value, start_values, sizeof m->now.value);
  m->now.stale = 1;
}

static Instance *instance_new(const char *name) {
  Instance *m = (Instance *)calloc(1, sizeof *m);
  if (!m) return NULL;
  if (name) strncpy(m->name, name, sizeof m->name - 1);
  instance_reset(m);
  return m;
}

/* Derivatives of all states, the azimuth among them, at some states and inputs. */
static int rates(const double *p, const double *x, const double *inputs, double *dx) {
  int failed = MODEL_DERIVATIVE(x, inputs, inputs + COUNT_CONTROLS, p, dx);
#if TURNS
  dx[COUNT_STATES - 1] = RADIANS * x[SPEED];
#endif
  return failed;
}

static int update(Instance *m) {
  double *v = m->now.value;
  int failed;
  if (!m->now.stale) return 0;
  failed = rates(v + AT_PARAMETERS, v + AT_STATES, v + AT_INPUTS, v + AT_RATES);
#if TURNS
  failed |= MODEL_OUTPUT(v + AT_STATES, v + AT_INPUTS, v + AT_INPUTS + COUNT_CONTROLS,
      v + AT_PARAMETERS, v[AT_STATES + COUNT_STATES - 1], v + AT_FIELD, v + AT_OUTPUTS);
#else
  failed |= MODEL_OUTPUT(v + AT_STATES, v + AT_INPUTS, v + AT_INPUTS + COUNT_CONTROLS,
      v + AT_PARAMETERS, v + AT_OUTPUTS);
#endif
  m->now.stale = failed;
  return failed;
}

static int get_value(Instance *m, unsigned int reference, double *value) {
  if (reference >= COUNT_ALL) return 1;
  if ((reference >= AT_RATES && reference < AT_INPUTS) || reference >= AT_OUTPUTS) {
    if (update(m)) return 1;
  }
  *value = m->now.value[reference];
  return 0;
}

static int set_value(Instance *m, unsigned int reference, double value) {
  int settable = (reference >= AT_STATES && reference < AT_RATES)
      || (reference >= AT_INPUTS && reference < AT_OUTPUTS);
  if (!settable || !isfinite(value) || (reference == AT_STEP && value <= 0.0)) return 1;
  m->now.value[reference] = value;
  m->now.stale = 1;
  return 0;
}

static const char *values_got(Instance *m, const unsigned int r[], size_t n, double v[]) {
  size_t i;
  for (i = 0; i < n; ++i) {
    if (get_value(m, r[i], &v[i])) return "there is no such variable";
  }
  return NULL;
}

static const char *values_set(Instance *m, const unsigned int r[], size_t n, const double v[]) {
  size_t i;
  for (i = 0; i < n; ++i) {
    if (set_value(m, r[i], v[i])) return "this variable cannot have this value";
  }
  return NULL;
}

static const char *states_copied(double *to, const double *from, size_t n) {
  if (n != COUNT_STATES) return "another number of states was expected";
  memcpy(to, from, n * sizeof *to);
  return NULL;
}

/* Keep a state in memory of its own, which is made if there is none. */
static int state_kept(void **kept, const void *state) {
  if (!*kept) *kept = malloc(sizeof(State));
  if (*kept) memcpy(*kept, state, sizeof(State));
  return *kept != NULL;
}

/* March to another time by classical Runge-Kutta steps of at most `step`. */
static int march(Instance *m, double start, double seconds) {
  static const double shares[4] = {0.0, 0.5, 0.5, 1.0};
  double *v = m->now.value, *x = v + AT_STATES;
  double k[4][COUNT_STATES], at[COUNT_STATES], inputs[COUNT_INPUTS + 1];
  double count, h;
  long n, steps;
  int i, s;
  if (!(seconds > 0.0)) return seconds != 0.0;
  count = ceil(seconds / v[AT_STEP] - 1e-6);
  if (!(count < 1e9)) return 1;
  steps = count < 1.0 ? 1 : (long)count;
  h = seconds / (double)steps;
  for (n = 0; n < steps; ++n) {
#if TURNS
    const double before = x[SPEED];
#endif
    for (s = 0; s < 4; ++s) {
      const double since = h * ((double)n + shares[s]);
      for (i = 0; i < COUNT_STATES; ++i) at[i] = s ? x[i] + shares[s] * h * k[s - 1][i] : x[i];
      for (i = 0; i < COUNT_INPUTS; ++i) inputs[i] = v[AT_INPUTS + i] + since * m->now.slope[i];
      if (rates(v + AT_PARAMETERS, at, inputs, k[s])) return 1;
    }
    for (i = 0; i < COUNT_STATES; ++i) {
      x[i] += h / 6.0 * (k[0][i] + 2.0 * k[1][i] + 2.0 * k[2][i] + k[3][i]);
    }
#if TURNS
    /* The azimuth is the integral of the speed by the trapezoidal rule, as in dfsm. */
    x[COUNT_STATES - 1] += 0.5 * h * RADIANS * (before + x[SPEED])
        - h / 6.0 * (k[0][i - 1] + 2.0 * k[1][i - 1] + 2.0 * k[2][i - 1] + k[3][i - 1]);
#endif
  }
  for (i = 0; i < COUNT_INPUTS; ++i) {
    v[AT_INPUTS + i] += seconds * m->now.slope[i];
    m->now.slope[i] = 0.0;
  }
  v[0] = start + seconds;
  m->now.stale = 1;
  for (i = 0; i < COUNT_STATES; ++i) {
    if (!isfinite(x[i])) return 1;
  }
  return 0;
}
