#include "model.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

Status model_fail(const Plant *plant, const char *format, ...) {
    char message[400];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(message, sizeof message, format, arguments);
    va_end(arguments);
    plant->log_error(plant, message);
    return FAILED;
}

Status model_absent(const Plant *plant, const char *function, size_t n) {
    return n ? model_fail(plant, "%s: this FMU has nothing for it", function) : OK;
}

Status model_require(const Plant *plant, int phases, const char *function) {
    if (plant->state.phase & phases) return OK;
    return model_fail(plant, "%s cannot be called in this mode", function);
}

/* ---- dynamics ---- */

/* Call a function of plant.h or derivatives.h with its arguments, its results and scratch memory. */
#define CALL(function, inputs, outputs)                                         \
    do {                                                                        \
        const double *arguments[function##_SZ_ARG] = {UNPACK inputs};           \
        double *results[function##_SZ_RES] = {UNPACK outputs};                  \
        double work[function##_SZ_W + 1];                                       \
        casadi_int integers[function##_SZ_IW + 1];                              \
        function(arguments, results, integers, work, 0);                        \
    } while (0)
#define UNPACK(...) __VA_ARGS__

static void require_constants(State *s) {
    if (s->constants_known) return;
    CALL(plant_constants, (s->values + PARAMETERS_AT), (s->constants));
    s->constants_known = 1;
}

/* The ideal case has shorter equations. */
static int is_ideal(const State *s) {
    for (int i = 0; i < DISTURBANCES; i++)
        if (s->values[disturbance_at[i]] != 0) return 0;
    return 1;
}

static void rates(const State *s, int ideal, const double *x, double *dx) {
    if (ideal) CALL(plant_ideal_rates, (x, s->values + INPUTS_AT, s->constants), (dx));
    else CALL(plant_rates, (x, s->values + INPUTS_AT, s->constants), (dx));
}

static void require_rates(State *s) {
    if (s->rates_known) return;
    require_constants(s);
    rates(s, is_ideal(s), s->values, s->values + RATES_AT);
    s->rates_known = 1;
}

static void require_outputs(State *s) {
    if (s->outputs_known) return;
    require_constants(s);
    if (is_ideal(s)) CALL(plant_ideal_outputs, (s->values, s->values + INPUTS_AT, s->constants), (s->values + OUTPUTS_AT));
    else CALL(plant_outputs, (s->values, s->values + INPUTS_AT, s->constants), (s->values + OUTPUTS_AT));
    s->outputs_known = 1;
}

static void invalidate(State *s) { s->outputs_known = s->rates_known = 0; }

static void place_at_start(State *s) {
    CALL(plant_start, (s->values + PARAMETERS_AT), (s->values));
    invalidate(s);
}

/* A state that decays would pass through the denormal numbers, where many processors are slow, and never reach zero. */
#define NEGLIGIBLE 1e-100

/* The classical Runge-Kutta method with equal substeps. */
static void integrate(State *s, double duration, long steps) {
    /* The states of disturbances, which are the last, stay zero in the ideal case. */
    double h = duration / steps, *x = s->values, k[4][STATES], at[STATES];
    int ideal = is_ideal(s), states = ideal ? IDEAL_STATES : STATES;
    require_constants(s);
    for (long step = 0; step < steps; step++) {
        rates(s, ideal, x, k[0]);
        for (int i = 0; i < states; i++) at[i] = x[i] + h / 2 * k[0][i];
        rates(s, ideal, at, k[1]);
        for (int i = 0; i < states; i++) at[i] = x[i] + h / 2 * k[1][i];
        rates(s, ideal, at, k[2]);
        for (int i = 0; i < states; i++) at[i] = x[i] + h * k[2][i];
        rates(s, ideal, at, k[3]);
        for (int i = 0; i < states; i++) {
            x[i] += h / 6 * (k[0][i] + 2 * k[1][i] + 2 * k[2][i] + k[3][i]);
            if (fabs(x[i]) < NEGLIGIBLE) x[i] = 0;
        }
#ifdef QUATERNION_AT
        double *q = x + QUATERNION_AT, scale = 1 / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        for (int i = 0; i < 4; i++) q[i] *= scale;
#endif
    }
    invalidate(s);
}

static int all_finite(const double *values, size_t n) {
    for (size_t i = 0; i < n; i++)
        if (!isfinite(values[i])) return 0;
    return 1;
}

static int is_parameter(unsigned v) { return kind[v] == FIXED || kind[v] == TUNABLE; }

static Status check_range(const Plant *plant, unsigned v, const double *values, int count) {
    for (int i = 0; i < count; i++)
        if (!(values[i] >= minimum[v] && values[i] <= maximum[v]))
            return model_fail(plant, "parameter %s is %g; it must be %g to %g", names[v], values[i], minimum[v], maximum[v]);
    return OK;
}

static Status check_conditions(const Plant *plant) {
    double values[CONDITIONS], limits[CONDITIONS];
    CALL(plant_conditions, (plant->state.values + PARAMETERS_AT), (values, limits));
    for (int i = 0; i < CONDITIONS; i++)
        if (!(values[i] <= limits[i])) return model_fail(plant, condition_texts[i], values[i], limits[i]);
    return OK;
}

static Status check_limits(const Plant *plant) {
    double values[LIMITS + 1], limits[LIMITS + 1];
    if (is_ideal(&plant->state)) CALL(plant_ideal_limits, (plant->state.values, plant->state.constants), (values, limits));
    else CALL(plant_limits, (plant->state.values, plant->state.constants), (values, limits));
    for (int i = 0; i < LIMITS; i++)
        if (!(values[i] <= limits[i])) return model_fail(plant, limit_texts[i], values[i], limits[i]);
    return OK;
}

/* ---- life ---- */

Plant *model_new(
    Phase after_initialization, const char *token, void (*log_error)(const Plant *, const char *), const void *importer) {
    Plant *plant = calloc(1, sizeof *plant);
    if (!plant) return 0;
    plant->after_initialization = after_initialization;
    plant->log_error = log_error;
    plant->importer = importer;
    Status status = OK;
    if (!after_initialization) status = model_fail(plant, "this FMU is for Co-Simulation alone");
    else if (!token || strcmp(token, TOKEN)) status = model_fail(plant, "the instantiationToken is not that of modelDescription.xml");
    if (status != OK) {
        free(plant);
        return 0;
    }
    model_reset(plant);
    return plant;
}

void model_free(Plant *plant) { free(plant); }

void model_reset(Plant *plant) {
    State *s = &plant->state;
    memset(s, 0, sizeof *s);
    s->phase = INSTANTIATED;
    memcpy(s->values, start, sizeof start);
    place_at_start(s);
}

Status model_enter_initialization(Plant *plant, double start_time) {
    if (plant->state.phase != INSTANTIATED) return model_fail(plant, "initialisation can be entered only once after instantiation");
    if (!isfinite(start_time)) return model_fail(plant, "the start time is not finite");
    plant->state.phase = INITIALIZING;
    plant->state.time = start_time;
    return OK;
}

Status model_exit_initialization(Plant *plant) {
    State *s = &plant->state;
    if (s->phase != INITIALIZING) return model_fail(plant, "not in initialisation mode");
    for (unsigned v = 0; v < VARIABLES; v++)
        if (is_parameter(v) && check_range(plant, v, s->values + offset[v], length[v]) != OK) return FAILED;
    if (check_conditions(plant) != OK) return FAILED;
    s->phase = plant->after_initialization;
    return OK;
}

Status model_terminate(Plant *plant) {
    if (model_require(plant, STEPPING | EVENTS | CONTINUOUS, "terminate") != OK) return FAILED;
    plant->state.phase = TERMINATED;
    return OK;
}

#define MOST_SUBSTEPS 1e8

Status model_step(Plant *plant, double time, double step) {
    State *s = &plant->state;
    if (s->phase != STEPPING) return model_fail(plant, "a step before the end of initialisation or after termination");
    if (!(step > 0) || !isfinite(step)) return model_fail(plant, "the communication step must be positive");
    if (!(fabs(time - s->time) <= 1e-6 * step + 1e-9 * fabs(time)))
        return model_fail(plant, "the communication point is %.9g s, but the last step ended at %.9g s", time, s->time);
    if (!all_finite(s->values + INPUTS_AT, INPUTS)) return model_fail(plant, "an input is not finite");
    double steps = ceil(step / s->values[SUBSTEP_AT] - 1e-9);
    if (steps > MOST_SUBSTEPS) return model_fail(plant, "a communication step of %g s takes more than %g substeps", step, MOST_SUBSTEPS);
    integrate(s, step, steps < 1 ? 1 : (long)steps);
    s->time = time + step;
    if (!all_finite(s->values, STATES)) return model_fail(plant, "the state is no longer finite: reduce substep, or check the parameters");
    return check_limits(plant);
}

void model_set_states(Plant *plant, const double *states) {
    memcpy(plant->state.values, states, STATES * sizeof(double));
    invalidate(&plant->state);
}

Status model_rates(Plant *plant, double *found) {
    State *s = &plant->state;
    require_rates(s);
    memcpy(found, s->values + RATES_AT, STATES * sizeof(double));
    if (check_limits(plant) != OK) return DISCARD;
    if (all_finite(found, STATES)) return OK;
    model_fail(plant, "a derivative is not finite");
    return DISCARD;
}

/* ---- variables ---- */

static Status check_type(const Plant *plant, unsigned v, int integer) {
    if (v >= VARIABLES) return model_fail(plant, "there is no variable of value reference %u", v);
    if ((kind[v] == DISCRETE_INPUT) != integer) return model_fail(plant, "%s is not a variable of this type", names[v]);
    return OK;
}

Status model_get(Plant *plant, unsigned v, int first, int count, int integer, double *values) {
    if (check_type(plant, v, integer) != OK) return FAILED;
    if (kind[v] == OUTPUT) require_outputs(&plant->state);
    if (kind[v] == RATE) require_rates(&plant->state);
    memcpy(values, plant->state.values + offset[v] + first, count * sizeof(double));
    return OK;
}

Status model_set(Plant *plant, unsigned v, int first, int count, int integer, const double *values) {
    State *s = &plant->state;
    if (check_type(plant, v, integer) != OK) return FAILED;
    if (kind[v] == OUTPUT || kind[v] == STATE || kind[v] == RATE) return model_fail(plant, "%s is calculated and cannot be set", names[v]);
    if (kind[v] == FIXED && s->phase >= STEPPING) return model_fail(plant, "%s is fixed once initialisation has ended", names[v]);
    if (s->phase == CONTINUOUS && kind[v] != INPUT) return model_fail(plant, "%s can change in event mode only", names[v]);
    double *place = s->values + offset[v] + first;
    if (integer)
        for (int i = 0; i < count; i++)
            if (values[i] < minimum[v] || values[i] > maximum[v])
                return model_fail(plant, "%s is %g; it must be 0 (open), 1 (brake) or 2 (velocity)", names[v], values[i]);
    /* The end of initialisation checks all parameters together; after it, `model_end_set` does. */
    if (kind[v] == TUNABLE && s->phase >= STEPPING) {
        if (check_range(plant, v, values, count) != OK) return FAILED;
        if (!plant->tuned) memcpy(plant->untuned, s->values + PARAMETERS_AT, sizeof plant->untuned);
        plant->tuned = 1;
    }
    memcpy(place, values, count * sizeof(double));
    invalidate(s);
    if (!is_parameter(v)) return OK;
    s->constants_known = 0;
    if (s->phase < STEPPING) place_at_start(s);
    return OK;
}

Status model_end_set(Plant *plant, Status so_far) {
    if (!plant->tuned) return so_far;
    plant->tuned = 0;
    if (so_far == OK && check_conditions(plant) == OK) return OK;
    memcpy(plant->state.values + PARAMETERS_AT, plant->untuned, sizeof plant->untuned);
    return FAILED;
}

/* ---- derivatives ---- */

Status model_may_derive(const Plant *plant, unsigned v, int unknown) {
    if (v >= VARIABLES) return model_fail(plant, "there is no variable of value reference %u", v);
    int state_follows = plant->state.phase < STEPPING;
    int possible = unknown ? kind[v] == OUTPUT || kind[v] == RATE || (kind[v] == STATE && state_follows)
                           : kind[v] == INPUT || is_parameter(v) || (kind[v] == STATE && !state_follows);
    if (!possible) return model_fail(plant, "%s cannot be %s of a derivative", names[v], unknown ? "an unknown" : "a known");
    return OK;
}

void model_forward(Plant *plant, const double *seed, double *sensitivity) {
    State *s = &plant->state;
    double constants[CONSTANTS];
    const double *states = seed;
    require_constants(s);
    CALL(plant_constants_forward, (s->values + PARAMETERS_AT, seed + PARAMETERS_AT), (constants));
    if (s->phase < STEPPING) {
        CALL(plant_start_forward, (s->values + PARAMETERS_AT, seed + PARAMETERS_AT), (sensitivity));
        states = sensitivity;
    }
    CALL(plant_forward, (s->values, s->values + INPUTS_AT, s->constants, states, seed + INPUTS_AT, constants),
         (sensitivity + RATES_AT, sensitivity + OUTPUTS_AT));
}

void model_reverse(Plant *plant, const double *seed, double *sensitivity) {
    State *s = &plant->state;
    double constants[CONSTANTS];
    require_constants(s);
    CALL(plant_reverse, (s->values, s->values + INPUTS_AT, s->constants, seed + RATES_AT, seed + OUTPUTS_AT),
         (sensitivity, sensitivity + INPUTS_AT, constants));
    CALL(plant_constants_reverse, (s->values + PARAMETERS_AT, constants), (sensitivity + PARAMETERS_AT));
    if (s->phase < STEPPING) {
        double through_start[PARAMETERS];
        for (int i = 0; i < STATES; i++) sensitivity[i] += seed[i];
        CALL(plant_start_reverse, (s->values + PARAMETERS_AT, sensitivity), (through_start));
        for (int i = 0; i < PARAMETERS; i++) sensitivity[PARAMETERS_AT + i] += through_start[i];
    }
}

/* ---- state ---- */

Status model_save(const Plant *plant, void **saved) {
    if (!*saved) *saved = malloc(sizeof(State));
    if (!*saved) return model_fail(plant, "out of memory");
    memcpy(*saved, &plant->state, sizeof(State));
    return OK;
}

Status model_restore(Plant *plant, const void *saved) {
    int running = plant->after_initialization == STEPPING ? STEPPING : EVENTS | CONTINUOUS;
    if (!(((const State *)saved)->phase & (INSTANTIATED | INITIALIZING | TERMINATED | running)))
        return model_fail(plant, "the saved state is of an instance for the other interface");
    memcpy(&plant->state, saved, sizeof(State));
    return OK;
}

Status model_serialize(const Plant *plant, const void *saved, void *bytes, size_t size) {
    if (size < sizeof(Serialized)) return model_fail(plant, "too few bytes for the serialised state");
    Serialized blob;
    memset(&blob, 0, sizeof blob);
    blob.layout = LAYOUT;
    memcpy(&blob.state, saved, sizeof(State));
    memcpy(bytes, &blob, sizeof blob);
    return OK;
}

Status model_deserialize(const Plant *plant, const void *bytes, size_t size, void **saved) {
    Serialized blob;
    if (size != sizeof blob) return model_fail(plant, "the serialised state has the wrong size");
    memcpy(&blob, bytes, sizeof blob);
    if (blob.layout != LAYOUT) return model_fail(plant, "the serialised state is from another build of this FMU");
    if (!*saved) *saved = malloc(sizeof(State));
    if (!*saved) return model_fail(plant, "out of memory");
    memcpy(*saved, &blob.state, sizeof(State));
    return OK;
}
