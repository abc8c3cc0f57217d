/* FMI 3.0 Co-Simulation around the generated dynamics of plant/dynamics.py.
 *
 * layout.h is generated from the table in plant/variables.py: all variables lie in one vector `values`, states first, and
 * each value reference names one variable of `length[]` scalars at `offset[]`. All state is one plain struct, so saving,
 * restoring and serialising it are copies. Integration is the classical Runge-Kutta method with equal substeps.
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi3Functions.h"
#include "layout.h"
#include "plant.h"

typedef enum { INSTANTIATED, INITIALIZING, STEPPING, TERMINATED } Phase;

typedef struct {
    double time;
    double values[VALUES];
    double constants[CONSTANTS];
    int constants_known;
    int outputs_known;
    Phase phase;
} State;

typedef struct {
    unsigned long long layout;
    State state;
} Serialized;

typedef struct {
    State state;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
    fmi3Boolean logging;
} Plant;

static fmi3Status fail(Plant *plant, const char *message) {
    if (plant->log && plant->logging) plant->log(plant->environment, fmi3Error, "logStatusError", message);
    return fmi3Error;
}

/* ---- dynamics ---- */

static void require_constants(State *s) {
    if (s->constants_known) return;
    const double *arguments[plant_constants_SZ_ARG] = {s->values + PARAMETERS_AT};
    double *results[plant_constants_SZ_RES] = {s->constants}, work[plant_constants_SZ_W + 1];
    casadi_int integers[plant_constants_SZ_IW + 1];
    plant_constants(arguments, results, integers, work, 0);
    s->constants_known = 1;
}

static void rates(const State *s, const double *x, double *dx) {
    const double *arguments[plant_rates_SZ_ARG] = {x, s->values + INPUTS_AT, s->constants};
    double *results[plant_rates_SZ_RES] = {dx}, work[plant_rates_SZ_W + 1];
    casadi_int integers[plant_rates_SZ_IW + 1];
    plant_rates(arguments, results, integers, work, 0);
}

static void require_outputs(State *s) {
    if (s->outputs_known) return;
    require_constants(s);
    const double *arguments[plant_outputs_SZ_ARG] = {s->values, s->values + INPUTS_AT, s->constants};
    double *results[plant_outputs_SZ_RES] = {s->values + OUTPUTS_AT}, work[plant_outputs_SZ_W + 1];
    casadi_int integers[plant_outputs_SZ_IW + 1];
    plant_outputs(arguments, results, integers, work, 0);
    s->outputs_known = 1;
}

static void normalize_quaternion(double *q) {
    double scale = 1 / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int i = 0; i < 4; i++) q[i] *= scale;
}

static void place_at_start(State *s) {
    memset(s->values, 0, STATES * sizeof(double));
    memcpy(s->values + POSITION_AT, s->values + INITIAL_POSITION_AT, 3 * sizeof(double));
    memcpy(s->values + QUATERNION_AT, s->values + INITIAL_QUATERNION_AT, 4 * sizeof(double));
    normalize_quaternion(s->values + QUATERNION_AT);
    s->outputs_known = 0;
}

static void integrate(State *s, double duration) {
    int steps = (int)ceil(duration / s->values[SUBSTEP_AT] - 1e-9);
    if (steps < 1) steps = 1;
    double h = duration / steps, *x = s->values, k[4][STATES], at[STATES];
    require_constants(s);
    for (int step = 0; step < steps; step++) {
        rates(s, x, k[0]);
        for (int i = 0; i < STATES; i++) at[i] = x[i] + h / 2 * k[0][i];
        rates(s, at, k[1]);
        for (int i = 0; i < STATES; i++) at[i] = x[i] + h / 2 * k[1][i];
        rates(s, at, k[2]);
        for (int i = 0; i < STATES; i++) at[i] = x[i] + h * k[2][i];
        rates(s, at, k[3]);
        for (int i = 0; i < STATES; i++) x[i] += h / 6 * (k[0][i] + 2 * k[1][i] + 2 * k[2][i] + k[3][i]);
        normalize_quaternion(x + QUATERNION_AT);
    }
    s->outputs_known = 0;
}

static int all_finite(const double *values, size_t n) {
    for (size_t i = 0; i < n; i++)
        if (!isfinite(values[i])) return 0;
    return 1;
}

static fmi3Status check_values(Plant *plant, int v, const double *values) {
    char message[200];
    for (int i = 0; i < length[v]; i++) {
        if (isfinite(values[i]) && values[i] >= minimum[v]) continue;
        snprintf(message, sizeof message, "parameter %s is %g; it must be finite and at least %g", names[v], values[i], minimum[v]);
        return fail(plant, message);
    }
    return fmi3OK;
}

static fmi3Status check_parameters(Plant *plant) {
    const double *values = plant->state.values;
    for (int v = 0; v < VARIABLES; v++)
        if ((kind[v] == FIXED || kind[v] == TUNABLE) && check_values(plant, v, values + offset[v]) != fmi3OK) return fmi3Error;
    const double *q = values + INITIAL_QUATERNION_AT;
    if (fabs(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] - 1) > 2e-3)
        return fail(plant, "parameter initial_quaternion is not a unit quaternion; normalise it");
    return fmi3OK;
}

/* ---- FMI 3.0: life ---- */

FMI3_Export const char *fmi3GetVersion(void) { return "3.0"; }

FMI3_Export fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean on, size_t n, const fmi3String categories[]) {
    (void)n, (void)categories;
    ((Plant *)instance)->logging = on;
    return fmi3OK;
}

static void reset(State *s) {
    memset(s, 0, sizeof *s);
    memcpy(s->values, start, sizeof start);
    place_at_start(s);
}

FMI3_Export fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean events,
    fmi3Boolean early_return, const fmi3ValueReference intermediate[], size_t n_intermediate,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update) {
    (void)name, (void)resources, (void)visible, (void)events, (void)early_return;
    (void)intermediate, (void)n_intermediate, (void)update;
    if (!token || strcmp(token, TOKEN)) {
        if (log && logging) log(environment, fmi3Error, "logStatusError", "the instantiationToken is not that of modelDescription.xml");
        return 0;
    }
    Plant *plant = malloc(sizeof *plant);
    if (!plant) return 0;
    plant->environment = environment;
    plant->log = log;
    plant->logging = logging;
    reset(&plant->state);
    return plant;
}

FMI3_Export void fmi3FreeInstance(fmi3Instance instance) { free(instance); }

FMI3_Export fmi3Status fmi3Reset(fmi3Instance instance) {
    reset(&((Plant *)instance)->state);
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3EnterInitializationMode(
    fmi3Instance instance, fmi3Boolean tolerance_defined, fmi3Float64 tolerance, fmi3Float64 start_time,
    fmi3Boolean stop_defined, fmi3Float64 stop_time) {
    (void)tolerance_defined, (void)tolerance, (void)stop_defined, (void)stop_time;
    Plant *plant = instance;
    if (plant->state.phase != INSTANTIATED) return fail(plant, "initialisation can be entered only once after instantiation");
    plant->state.phase = INITIALIZING;
    plant->state.time = start_time;
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) {
    Plant *plant = instance;
    if (plant->state.phase != INITIALIZING) return fail(plant, "not in initialisation mode");
    if (check_parameters(plant) != fmi3OK) return fmi3Error;
    plant->state.phase = STEPPING;
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3Terminate(fmi3Instance instance) {
    ((Plant *)instance)->state.phase = TERMINATED;
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3DoStep(
    fmi3Instance instance, fmi3Float64 time, fmi3Float64 step, fmi3Boolean no_set_state, fmi3Boolean *event,
    fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *reached) {
    (void)no_set_state;
    Plant *plant = instance;
    State *s = &plant->state;
    *event = *terminate = *early = fmi3False;
    *reached = s->time;
    if (s->phase != STEPPING) return fail(plant, "fmi3DoStep before the end of initialisation or after termination");
    if (!(step > 0) || !isfinite(step)) return fail(plant, "the communication step must be positive");
    if (fabs(time - s->time) > 1e-6 * step + 1e-9 * fabs(time)) return fail(plant, "the communication point is not where the last step ended");
    if (!all_finite(s->values + INPUTS_AT, INPUTS)) return fail(plant, "an input is not finite");
    integrate(s, step);
    s->time = time + step;
    if (!all_finite(s->values, STATES)) return fail(plant, "the state is no longer finite: reduce substep, or check the parameters");
    *reached = s->time;
    return fmi3OK;
}

/* ---- FMI 3.0: variables ---- */

static fmi3Status may_set(Plant *plant, fmi3ValueReference v, int discrete) {
    Phase phase = plant->state.phase;
    char message[160];
    const char *why = 0;
    if (v >= VARIABLES || (kind[v] == DISCRETE_INPUT) != discrete) why = "is not a variable of this type";
    else if (kind[v] == OUTPUT) why = "is an output and cannot be set";
    else if (kind[v] == FIXED && phase >= STEPPING) why = "is fixed once initialisation has ended";
    if (!why) return fmi3OK;
    snprintf(message, sizeof message, "%s (value reference %u) %s", v < VARIABLES ? names[v] : "?", v, why);
    return fail(plant, message);
}

static void note_set(State *s, fmi3ValueReference v) {
    s->outputs_known = 0;
    if (kind[v] != FIXED && kind[v] != TUNABLE) return;
    s->constants_known = 0;
    if (s->phase < STEPPING) place_at_start(s);
}

FMI3_Export fmi3Status fmi3GetFloat64(
    fmi3Instance instance, const fmi3ValueReference references[], size_t n, fmi3Float64 values[], size_t n_values) {
    Plant *plant = instance;
    State *s = &plant->state;
    size_t at = 0;
    for (size_t i = 0; i < n; i++) {
        fmi3ValueReference v = references[i];
        if (v == TIME_REFERENCE) {
            if (at + 1 > n_values) return fail(plant, "fmi3GetFloat64: too few values");
            values[at++] = s->time;
            continue;
        }
        if (v >= VARIABLES || kind[v] == DISCRETE_INPUT) return fail(plant, "fmi3GetFloat64: no Float64 variable has that value reference");
        if (at + length[v] > n_values) return fail(plant, "fmi3GetFloat64: too few values");
        if (kind[v] == OUTPUT) require_outputs(s);
        memcpy(values + at, s->values + offset[v], length[v] * sizeof(double));
        at += length[v];
    }
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3SetFloat64(
    fmi3Instance instance, const fmi3ValueReference references[], size_t n, const fmi3Float64 values[], size_t n_values) {
    Plant *plant = instance;
    size_t at = 0;
    for (size_t i = 0; i < n; i++) {
        fmi3ValueReference v = references[i];
        if (may_set(plant, v, 0) != fmi3OK) return fmi3Error;
        if (at + length[v] > n_values) return fail(plant, "fmi3SetFloat64: too few values");
        /* Before the end of initialisation parameters may be set one after the other; then all are checked together. */
        if (kind[v] == TUNABLE && plant->state.phase >= STEPPING && check_values(plant, v, values + at) != fmi3OK) return fmi3Error;
        memcpy(plant->state.values + offset[v], values + at, length[v] * sizeof(double));
        at += length[v];
        note_set(&plant->state, v);
    }
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3GetInt64(
    fmi3Instance instance, const fmi3ValueReference references[], size_t n, fmi3Int64 values[], size_t n_values) {
    Plant *plant = instance;
    size_t at = 0;
    for (size_t i = 0; i < n; i++) {
        fmi3ValueReference v = references[i];
        if (v >= VARIABLES || kind[v] != DISCRETE_INPUT) return fail(plant, "fmi3GetInt64: no enumeration has that value reference");
        if (at + length[v] > n_values) return fail(plant, "fmi3GetInt64: too few values");
        for (int j = 0; j < length[v]; j++) values[at++] = (fmi3Int64)plant->state.values[offset[v] + j];
    }
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3SetInt64(
    fmi3Instance instance, const fmi3ValueReference references[], size_t n, const fmi3Int64 values[], size_t n_values) {
    Plant *plant = instance;
    size_t at = 0;
    for (size_t i = 0; i < n; i++) {
        fmi3ValueReference v = references[i];
        if (may_set(plant, v, 1) != fmi3OK) return fmi3Error;
        if (at + length[v] > n_values) return fail(plant, "fmi3SetInt64: too few values");
        for (int j = 0; j < length[v]; j++, at++) {
            if (values[at] < 0 || values[at] >= DRIVE_MODES) return fail(plant, "drive_mode must be 0 (open), 1 (brake) or 2 (velocity)");
            plant->state.values[offset[v] + j] = (double)values[at];
        }
        note_set(&plant->state, v);
    }
    return fmi3OK;
}

/* ---- FMI 3.0: state ---- */

FMI3_Export fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *saved) {
    Plant *plant = instance;
    if (!*saved) *saved = malloc(sizeof(State));
    if (!*saved) return fail(plant, "out of memory");
    memcpy(*saved, &plant->state, sizeof(State));
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState saved) {
    memcpy(&((Plant *)instance)->state, saved, sizeof(State));
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *saved) {
    (void)instance;
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
    if (size < sizeof(Serialized)) return fail(instance, "too few bytes for the serialised state");
    Serialized blob;
    memset(&blob, 0, sizeof blob);
    blob.layout = LAYOUT;
    memcpy(&blob.state, saved, sizeof(State));
    memcpy(bytes, &blob, sizeof blob);
    return fmi3OK;
}

FMI3_Export fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte bytes[], size_t size, fmi3FMUState *saved) {
    Serialized blob;
    if (size != sizeof blob) return fail(instance, "the serialised state has the wrong size");
    memcpy(&blob, bytes, sizeof blob);
    if (blob.layout != LAYOUT) return fail(instance, "the serialised state is from another build of this FMU");
    if (!*saved) *saved = malloc(sizeof(State));
    if (!*saved) return fail(instance, "out of memory");
    memcpy(*saved, &blob.state, sizeof(State));
    return fmi3OK;
}
