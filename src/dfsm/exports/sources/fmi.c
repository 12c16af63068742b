/* What both versions of FMI have, but for names. The file of a version stands before this. */
#define DO(name) \
  API FMI(Status) FMI(name)(void *c) { SELF; return FMI(OK); }

API FMI(Status) FMI(SetDebugLogging)(void *c, FMI(Boolean) on, size_t n, const char *const k[]) {
  SELF; (void)n; (void)k; m->logging = on; return FMI(OK);
}
API void FMI(FreeInstance)(void *c) { free(c); }
API FMI(Status) FMI(Reset)(void *c) { SELF; instance_reset(m); return FMI(OK); }
DO(ExitInitializationMode)
DO(Terminate)

/* -- all values at once -- */
API FMI(Status) STATE(Get, )(void *c, void **s) {
  SELF; ANSWER(state_kept(s, &m->now) ? NULL : "there is no memory for a state");
}
API FMI(Status) STATE(Set, )(void *c, void *s) {
  SELF;
  if (s) memcpy(&m->now, s, sizeof(State));
  ANSWER(s ? NULL : "there is no state to set");
}
API FMI(Status) STATE(Free, )(void *c, void **s) {
  (void)c; if (s) { free(*s); *s = NULL; } return FMI(OK);
}
API FMI(Status) STATE(Serialized, Size)(void *c, void *s, size_t *n) {
  (void)c; (void)s; *n = sizeof(State); return FMI(OK);
}
API FMI(Status) STATE(Serialize, )(void *c, void *s, Byte b[], size_t n) {
  (void)c; if (n < sizeof(State)) return FMI(Error); memcpy(b, s, sizeof(State)); return FMI(OK);
}
API FMI(Status) DESERIALIZE(void *c, const Byte b[], size_t n, void **s) {
  (void)c; return n == sizeof(State) && state_kept(s, b) ? FMI(OK) : FMI(Error);
}

/* -- model exchange -- */
DO(EnterEventMode)
DO(EnterContinuousTimeMode)
API FMI(Status) FMI(CompletedIntegratorStep)(void *c, FMI(Boolean) noSetPrior,
    FMI(Boolean) *event, FMI(Boolean) *terminate) {
  SELF; (void)noSetPrior; *event = *terminate = 0; return FMI(OK);
}
API FMI(Status) FMI(SetTime)(void *c, double t) { SELF; m->now.value[0] = t; return FMI(OK); }
API FMI(Status) FMI(SetContinuousStates)(void *c, const double x[], size_t n) {
  SELF;
  m->now.stale = 1;
  ANSWER(states_copied(m->now.value + AT__STATES, x, n));
}
API FMI(Status) FMI(GetContinuousStates)(void *c, double x[], size_t n) {
  SELF; ANSWER(states_copied(x, m->now.value + AT__STATES, n));
}
API FMI(Status) DERIVATIVES(void *c, double dx[], size_t n) {
  SELF;
  ANSWER(update(m) ? "no derivatives of these states"
                   : states_copied(dx, m->now.value + AT__RATES, n));
}
API FMI(Status) FMI(GetNominalsOfContinuousStates)(void *c, double x[], size_t n) {
  SELF; ANSWER(states_copied(x, nominal_values, n));
}
API FMI(Status) FMI(GetEventIndicators)(void *c, double z[], size_t n) {
  SELF; (void)z; ANSWER(n ? "there are no event indicators" : NULL);
}
