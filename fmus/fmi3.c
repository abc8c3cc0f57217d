/* FMI 3.0, Co-Simulation and Model Exchange: every variable of the table is one array, whose value reference is its index. */
#include <math.h>
#include <stdlib.h>

#include "fmi3Functions.h"
#include "model.h"

typedef struct {
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
} Importer;

static void log_error(const Plant *plant, const char *message) {
    const Importer *importer = plant->importer;
    if (importer->log) importer->log(importer->environment, fmi3Error, "logStatusError", message);
}

/* ---- life ---- */

FMI3_Export const char *fmi3GetVersion(void) { return "3.0"; }

FMI3_Export fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean on, size_t n, const fmi3String categories[]) {
    (void)instance, (void)on, (void)n, (void)categories; /* errors are always logged, and nothing else is */
    return fmi3OK;
}

static fmi3Instance instantiate(Phase after, fmi3String token, fmi3InstanceEnvironment environment, fmi3LogMessageCallback log) {
    Importer *importer = malloc(sizeof *importer);
    if (!importer) return 0;
    importer->environment = environment;
    importer->log = log;
    Plant *plant = model_new(after, token, log_error, importer);
    if (!plant) free(importer);
    return plant;
}

FMI3_Export fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean events,
    fmi3Boolean early_return, const fmi3ValueReference intermediate[], size_t n_intermediate,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
    (void)name, (void)resources, (void)visible, (void)logging, (void)events, (void)early_return;
    (void)intermediate, (void)n_intermediate, (void)update;
    return instantiate(STEPPING, token, environment, log);
}

FMI3_Export fmi3Instance fmi3InstantiateModelExchange(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log) {
    (void)name, (void)resources, (void)visible, (void)logging;
    return instantiate(EVENTS, token, environment, log);
}

FMI3_Export void fmi3FreeInstance(fmi3Instance instance) {
    Plant *plant = instance;
    if (!plant) return;
    free((void *)plant->importer);
    model_free(plant);
}

FMI3_Export fmi3Status fmi3Reset(fmi3Instance instance) {
    model_reset(instance);
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3EnterInitializationMode(
    fmi3Instance instance, fmi3Boolean tolerance_defined, fmi3Float64 tolerance, fmi3Float64 start_time,
    fmi3Boolean stop_defined, fmi3Float64 stop_time) {
    (void)tolerance_defined, (void)tolerance, (void)stop_defined, (void)stop_time;
    return (fmi3Status)model_enter_initialization(instance, start_time);
}

FMI3_Export fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) {
    return (fmi3Status)model_exit_initialization(instance);
}

FMI3_Export fmi3Status fmi3Terminate(fmi3Instance instance) { return (fmi3Status)model_terminate(instance); }

/* ---- Co-Simulation ---- */

FMI3_Export fmi3Status fmi3DoStep(
    fmi3Instance instance, fmi3Float64 time, fmi3Float64 step, fmi3Boolean no_set_state, fmi3Boolean *event,
    fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *reached) {
    (void)no_set_state;
    Plant *plant = instance;
    *event = *terminate = *early = fmi3False;
    fmi3Status status = (fmi3Status)model_step(plant, time, step);
    *reached = plant->state.time;
    return status;
}

/* ---- Model Exchange ---- */

#define REQUIRE(phases)                                                                \
    do {                                                                               \
        if (model_require(instance, phases, __func__) != OK) return fmi3Error;         \
    } while (0)

FMI3_Export fmi3Status fmi3EnterEventMode(fmi3Instance instance) {
    REQUIRE(CONTINUOUS);
    ((Plant *)instance)->state.phase = EVENTS;
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance instance) {
    REQUIRE(EVENTS);
    ((Plant *)instance)->state.phase = CONTINUOUS;
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3UpdateDiscreteStates(
    fmi3Instance instance, fmi3Boolean *again, fmi3Boolean *terminate, fmi3Boolean *nominals_changed,
    fmi3Boolean *values_changed, fmi3Boolean *next_event_defined, fmi3Float64 *next_event) {
    REQUIRE(EVENTS);
    *again = *terminate = *nominals_changed = *values_changed = *next_event_defined = fmi3False;
    *next_event = 0;
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3CompletedIntegratorStep(
    fmi3Instance instance, fmi3Boolean no_set_state, fmi3Boolean *enter_events, fmi3Boolean *terminate) {
    (void)no_set_state;
    REQUIRE(CONTINUOUS);
    *enter_events = *terminate = fmi3False;
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3SetTime(fmi3Instance instance, fmi3Float64 time) {
    REQUIRE(EVENTS | CONTINUOUS);
    ((Plant *)instance)->state.time = time;
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *n) {
    (void)instance;
    *n = STATES;
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *n) {
    (void)instance;
    *n = 0;
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3GetEventIndicators(fmi3Instance instance, fmi3Float64 indicators[], size_t n) {
    (void)indicators;
    return (fmi3Status)model_absent(instance, __func__, n);
}

static int has_all_states(fmi3Instance instance, size_t n) {
    if (n == STATES) return 1;
    model_fail(instance, "there are %d continuous states, not %d", STATES, (int)n);
    return 0;
}

FMI3_Export fmi3Status fmi3GetContinuousStates(fmi3Instance instance, fmi3Float64 states[], size_t n) {
    if (!has_all_states(instance, n)) return fmi3Error;
    for (size_t i = 0; i < n; i++) states[i] = ((Plant *)instance)->state.values[i];
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3SetContinuousStates(fmi3Instance instance, const fmi3Float64 states[], size_t n) {
    REQUIRE(CONTINUOUS);
    if (!has_all_states(instance, n)) return fmi3Error;
    model_set_states(instance, states);
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance instance, fmi3Float64 nominals[], size_t n) {
    if (!has_all_states(instance, n)) return fmi3Error;
    for (int v = 0; v < VARIABLES; v++)
        for (int i = 0; kind[v] == STATE && i < length[v]; i++) nominals[offset[v] + i] = nominal[v];
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance instance, fmi3Float64 derivatives[], size_t n) {
    REQUIRE(INITIALIZING | EVENTS | CONTINUOUS);
    return has_all_states(instance, n) ? (fmi3Status)model_rates(instance, derivatives) : fmi3Error;
}

/* ---- variables ---- */

static int length_of(fmi3ValueReference v) { return v < VARIABLES ? length[v] : 0; }

static int fits(fmi3Instance instance, fmi3ValueReference v, size_t at, size_t n_values) {
    if (at + length_of(v) <= n_values) return 1;
    model_fail(instance, "too few values: %s needs %d", names[v], length[v]);
    return 0;
}

FMI3_Export fmi3Status fmi3GetFloat64(
    fmi3Instance instance, const fmi3ValueReference references[], size_t n, fmi3Float64 values[], size_t n_values) {
    for (size_t i = 0, at = 0; i < n; i++) {
        fmi3ValueReference v = references[i];
        if (v == VARIABLES) {
            if (at + 1 > n_values) return (fmi3Status)model_fail(instance, "too few values: time needs 1");
            values[at++] = ((Plant *)instance)->state.time;
            continue;
        }
        if (!fits(instance, v, at, n_values)) return fmi3Error;
        if (model_get(instance, v, 0, length_of(v), 0, values + at) != OK) return fmi3Error;
        at += length_of(v);
    }
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3SetFloat64(
    fmi3Instance instance, const fmi3ValueReference references[], size_t n, const fmi3Float64 values[], size_t n_values) {
    Status status = OK;
    for (size_t i = 0, at = 0; i < n && status == OK; i++) {
        fmi3ValueReference v = references[i];
        status = fits(instance, v, at, n_values) ? model_set(instance, v, 0, length_of(v), 0, values + at) : FAILED;
        at += length_of(v);
    }
    return (fmi3Status)model_end_set(instance, status);
}

FMI3_Export fmi3Status fmi3GetInt64(
    fmi3Instance instance, const fmi3ValueReference references[], size_t n, fmi3Int64 values[], size_t n_values) {
    double whole[LONGEST];
    for (size_t i = 0, at = 0; i < n; i++) {
        fmi3ValueReference v = references[i];
        if (!fits(instance, v, at, n_values)) return fmi3Error;
        if (model_get(instance, v, 0, length_of(v), 1, whole) != OK) return fmi3Error;
        for (int j = 0; j < length_of(v); j++) values[at++] = (fmi3Int64)whole[j];
    }
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3SetInt64(
    fmi3Instance instance, const fmi3ValueReference references[], size_t n, const fmi3Int64 values[], size_t n_values) {
    double whole[LONGEST];
    for (size_t i = 0, at = 0; i < n; i++) {
        fmi3ValueReference v = references[i];
        int count = length_of(v);
        if (!fits(instance, v, at, n_values)) return fmi3Error;
        for (int j = 0; j < count; j++) whole[j] = (double)values[at + j];
        if (model_set(instance, v, 0, count, 1, whole) != OK) return fmi3Error;
        at += count;
    }
    return fmi3OK;
}

/* ---- derivatives ---- */

/* Check the unknowns or the knowns of a derivative; if `values` are given, add them at their places in `vector`. */
static int scatter(
    fmi3Instance instance, const fmi3ValueReference references[], size_t n, int unknown, const fmi3Float64 values[],
    size_t n_values, double *vector) {
    size_t at = 0;
    for (size_t i = 0; i < n; i++) {
        fmi3ValueReference v = references[i];
        if (model_may_derive(instance, v, unknown) != OK) return 0;
        if (values && !fits(instance, v, at, n_values)) return 0;
        for (int j = 0; values && j < length[v]; j++) vector[offset[v] + j] += values[at + j];
        at += length[v];
    }
    if (at == n_values) return 1;
    model_fail(instance, "the variables have %d values, and not %d", (int)at, (int)n_values);
    return 0;
}

static void gather(const fmi3ValueReference references[], size_t n, const double *vector, fmi3Float64 sensitivity[]) {
    for (size_t i = 0; i < n; i++)
        for (int j = 0; j < length[references[i]]; j++) *sensitivity++ = vector[offset[references[i]] + j];
}

FMI3_Export fmi3Status fmi3GetDirectionalDerivative(
    fmi3Instance instance, const fmi3ValueReference unknowns[], size_t n_unknowns, const fmi3ValueReference knowns[],
    size_t n_knowns, const fmi3Float64 seed[], size_t n_seed, fmi3Float64 sensitivity[], size_t n_sensitivity) {
    double known[VALUES] = {0}, unknown[VALUES] = {0};
    if (!scatter(instance, knowns, n_knowns, 0, seed, n_seed, known)) return fmi3Error;
    if (!scatter(instance, unknowns, n_unknowns, 1, 0, n_sensitivity, 0)) return fmi3Error;
    model_forward(instance, known, unknown);
    gather(unknowns, n_unknowns, unknown, sensitivity);
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3GetAdjointDerivative(
    fmi3Instance instance, const fmi3ValueReference unknowns[], size_t n_unknowns, const fmi3ValueReference knowns[],
    size_t n_knowns, const fmi3Float64 seed[], size_t n_seed, fmi3Float64 sensitivity[], size_t n_sensitivity) {
    double known[VALUES] = {0}, unknown[VALUES] = {0};
    if (!scatter(instance, unknowns, n_unknowns, 1, seed, n_seed, unknown)) return fmi3Error;
    if (!scatter(instance, knowns, n_knowns, 0, 0, n_sensitivity, 0)) return fmi3Error;
    model_reverse(instance, unknown, known);
    gather(knowns, n_knowns, known, sensitivity);
    return fmi3OK;
}

/* ---- state ---- */

FMI3_Export fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *saved) {
    return (fmi3Status)model_save(instance, saved);
}

FMI3_Export fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState saved) {
    return (fmi3Status)model_restore(instance, saved);
}

FMI3_Export fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *saved) {
    (void)instance;
    if (!saved) return fmi3OK;
    free(*saved);
    *saved = 0;
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState saved, size_t *size) {
    (void)instance, (void)saved;
    *size = sizeof(Serialized);
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState saved, fmi3Byte bytes[], size_t size) {
    return (fmi3Status)model_serialize(instance, saved, bytes, size);
}

FMI3_Export fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte bytes[], size_t size, fmi3FMUState *saved) {
    return (fmi3Status)model_deserialize(instance, bytes, size, saved);
}
