/* The plant behind both versions of FMI: the life of an instance, its variables and its derivatives.
 *
 * layout.h is generated from the plant's variable table. One vector `values` holds all variables, states first and their
 * derivatives last; variable v is `length[v]` scalars at `offset[v]`. The whole state is one plain struct, which is copied to
 * save, restore and serialise it. plant.h, disturbed.h and derivatives.h are generated from the plant's dynamics.
 */
#pragma once
#include <stddef.h>

#include "derivatives.h"
#include "disturbed.h"
#include "layout.h"
#include "plant.h"

typedef enum { OK, WARNING, DISCARD, FAILED } Status; /* the numbers of both versions */

/* One bit each, in the order of an instance's life. */
typedef enum { INSTANTIATED = 1, INITIALIZING = 2, STEPPING = 4, EVENTS = 8, CONTINUOUS = 16, TERMINATED = 32 } Phase;

typedef struct {
    double time;
    double values[VALUES];
    double constants[CONSTANTS];
    int constants_known, outputs_known, rates_known;
    Phase phase;
} State;

typedef struct {
    unsigned long long layout;
    State state;
} Serialized;

typedef struct Plant Plant;

struct Plant {
    State state;
    Phase after_initialization; /* STEPPING for Co-Simulation, EVENTS for Model Exchange */
    int tuned;                  /* whether parameters have been set since `model_end_set` */
    double untuned[PARAMETERS]; /* their values before */
    void (*log_error)(const Plant *, const char *message);
    const void *importer; /* for `log_error` */
};

Status model_fail(const Plant *plant, const char *format, ...);
Status model_absent(const Plant *plant, const char *function, size_t n); /* fails if n > 0 */
Status model_require(const Plant *plant, int phases, const char *function);
Plant *model_new(
    Phase after_initialization, const char *token, void (*log_error)(const Plant *, const char *), const void *importer);
void model_free(Plant *plant);
void model_reset(Plant *plant);

Status model_enter_initialization(Plant *plant, double start_time);
Status model_exit_initialization(Plant *plant);
Status model_terminate(Plant *plant);
Status model_step(Plant *plant, double time, double step);

/* Elements first to first + count - 1 of a variable; `integer` is whether the importer uses an integer function.
 * `model_end_set` checks all tunable parameters together, and restores them if the check or `so_far` is no success. */
Status model_get(Plant *plant, unsigned variable, int first, int count, int integer, double *values);
Status model_set(Plant *plant, unsigned variable, int first, int count, int integer, const double *values);
Status model_end_set(Plant *plant, Status so_far);

void model_set_states(Plant *plant, const double *states);
Status model_rates(Plant *plant, double *rates);

/* The Jacobian of outputs and derivatives by continuous inputs, states and parameters, or its transpose, times a vector; all
 * vectors have VALUES elements. Until initialisation ends, states are unknowns that follow from the parameters.
 * `model_may_derive` checks whether a variable can be an unknown or a known. */
Status model_may_derive(const Plant *plant, unsigned variable, int unknown);
void model_forward(Plant *plant, const double *seed, double *sensitivity);
void model_reverse(Plant *plant, const double *seed, double *sensitivity);

Status model_save(const Plant *plant, void **saved);
Status model_serialize(const Plant *plant, const void *saved, void *bytes, size_t size);
Status model_deserialize(const Plant *plant, const void *bytes, size_t size, void **saved);
Status model_restore(Plant *plant, const void *saved);
