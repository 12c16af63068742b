/* Functions of FMI 2.0 around an instance of the model. */
typedef void *fmi2Component;
typedef unsigned int fmi2ValueReference;
typedef int fmi2Boolean;
typedef int fmi2Status;
enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending };
typedef void (*fmi2Logger)(void *, const char *, fmi2Status, const char *, const char *, ...);
typedef struct {
  fmi2Logger logger;
  void *(*allocate)(size_t, size_t);
  void (*release)(void *);
  void (*finished)(void *, fmi2Status);
  void *environment;
} fmi2CallbackFunctions;
typedef struct {
  fmi2Boolean newDiscreteStatesNeeded, terminateSimulation, nominalsOfContinuousStatesChanged;
  fmi2Boolean valuesOfContinuousStatesChanged, nextEventTimeDefined;
  double nextEventTime;
} fmi2EventInfo;

/* What fmi.c takes. */
#define FMI(name) fmi2##name
#define STATE(before, after) fmi2##before##FMUstate##after
#define DESERIALIZE fmi2DeSerializeFMUstate
#define DERIVATIVES fmi2GetDerivatives
typedef char Byte;

static fmi2Status told(Instance *m, fmi2Status status, const char *text) {
  if (status != fmi2OK && m->logger) {
    const char *kind = status == fmi2Warning ? "logStatusWarning" : "logStatusError";
    ((fmi2Logger)m->logger)(m->environment, m->name, status, kind, text);
  }
  return status;
}

API const char *fmi2GetTypesPlatform(void) { return "default"; }
API const char *fmi2GetVersion(void) { return "2.0"; }

API fmi2Component fmi2Instantiate(const char *name, int type, const char *guid,
    const char *resources, const fmi2CallbackFunctions *callbacks, fmi2Boolean visible,
    fmi2Boolean logging) {
  Instance *m;
  (void)type; (void)resources; (void)visible;
  if (!guid || strcmp(guid, MODEL_TOKEN)) return NULL;
  m = instance_new(name);
  if (m && callbacks) {
    m->logger = (Function)callbacks->logger;
    m->environment = callbacks->environment;
    m->logging = logging;
  }
  return m;
}
API fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, double tolerance,
    double start, fmi2Boolean stopDefined, double stop) {
  SELF; (void)toleranceDefined; (void)tolerance; (void)stopDefined; (void)stop;
  m->now.value[0] = start; return fmi2OK;
}
API fmi2Status fmi2EnterInitializationMode(fmi2Component c) { SELF; return fmi2OK; }

API fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference r[], size_t n, double v[]) {
  SELF; ANSWER(values_got(m, r, n, v));
}
API fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference r[], size_t n, const double v[]) {
  SELF; ANSWER(values_set(m, r, n, v));
}
#define NONE(name, type) \
  API fmi2Status name(fmi2Component c, const fmi2ValueReference r[], size_t n, type v[]) { \
    SELF; (void)r; (void)v; return n ? told(m, fmi2Error, "all variables are reals") : fmi2OK; \
  }
NONE(fmi2GetInteger, int)
NONE(fmi2GetBoolean, fmi2Boolean)
NONE(fmi2GetString, const char *)
NONE(fmi2SetInteger, const int)
NONE(fmi2SetBoolean, const fmi2Boolean)
NONE(fmi2SetString, const char *const)

API fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference u[], size_t nu,
    const fmi2ValueReference k[], size_t nk, const double dv[], double d[]) {
  SELF; (void)u; (void)nu; (void)k; (void)nk; (void)dv; (void)d;
  return told(m, fmi2Error, "directional derivatives are not provided");
}

/* -- model exchange -- */
API fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info) {
  SELF; memset(info, 0, sizeof *info); return fmi2OK;
}

/* -- co-simulation -- */
API fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference r[], size_t n,
    const int order[], const double v[]) {
  size_t i;
  SELF;
  for (i = 0; i < n; ++i) {
    if (order[i] < 1 || order[i] > 3 || r[i] < AT__INPUTS || r[i] >= AT__PARAMETERS
        || !isfinite(v[i])) {
      return told(m, fmi2Error, "first to third derivatives of inputs can be set");
    }
    m->now.slope[order[i] - 1][r[i] - AT__INPUTS] = v[i];
  }
  return fmi2OK;
}
API fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference r[], size_t n,
    const int order[], double v[]) {
  SELF; (void)r; (void)order; (void)v;
  return n ? told(m, fmi2Error, "derivatives of outputs are not provided") : fmi2OK;
}
API fmi2Status fmi2DoStep(fmi2Component c, double t, double h, fmi2Boolean noSetPrior) {
  const char *problem;
  SELF;
  (void)noSetPrior;
  problem = march(m, t, h);
  if (!problem && strays(m)) told(m, fmi2Warning, STRAYED);
  return problem ? told(m, fmi2Error, problem) : fmi2OK;
}
API fmi2Status fmi2CancelStep(fmi2Component c) { SELF; return fmi2Error; }
API fmi2Status fmi2GetStatus(fmi2Component c, int k, fmi2Status *v) {
  SELF; (void)k; (void)v; return fmi2Discard;
}
API fmi2Status fmi2GetRealStatus(fmi2Component c, int k, double *v) {
  SELF; if (k == 2) { *v = m->now.value[0]; return fmi2OK; } return fmi2Discard;
}
API fmi2Status fmi2GetIntegerStatus(fmi2Component c, int k, int *v) {
  SELF; (void)k; (void)v; return fmi2Discard;
}
API fmi2Status fmi2GetBooleanStatus(fmi2Component c, int k, fmi2Boolean *v) {
  SELF; (void)k; (void)v; return fmi2Discard;
}
API fmi2Status fmi2GetStringStatus(fmi2Component c, int k, const char **v) {
  SELF; (void)k; (void)v; return fmi2Discard;
}
