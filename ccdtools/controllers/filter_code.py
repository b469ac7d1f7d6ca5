"""C99 source of a Kalman filter, the memory of a policy of its estimate."""

from __future__ import annotations

from typing import Any

import numpy as np

from mpc.explicit.codegen.c_source import table

FILTER_HEADER = """
#define @NAME@_NY @ny@ /* outputs */

/* Estimate of a Kalman filter, theta of the law, and its covariance. One for each loop. */
typedef struct {
    @name@_real theta[@NAME@_NT];
    @name@_real covariance[@NAME@_NT][@NAME@_NT];
    int begun;
} @name@_state;

/* What is known before the first sample. */
void @name@_reset(@name@_state *state);

/* Write the input that belongs to an output into u. The input of the sample before, as it was applied, may be u itself;
   before the first sample it is zero. Returns what the law returns. */
int @name@_step(@name@_state *state, const @name@_real y[@NAME@_NY], const @name@_real u_prev[@NAME@_NU],
                @name@_real u[@NAME@_NU]);

#endif
"""

FILTER = """
#define NY @NAME@_NY

static const real state_matrix[NT][NT] = @A@;
static const real input_matrix[NT][NU] = @B@;
static const real drift[NT] = @c@;
static const real process_noise[NT][NT] = @W@;
static const real first_estimate[NT] = @x0@;
static const real first_covariance[NT][NT] = @P0@;
/* outputs in units of their noise: scale y = seen x + through u + offset + noise of variance one */
static const real scale[NY][NY] = @scale@;
static const real seen[NY][NT] = @seen@;
static const real through[NY][NU] = @through@;
static const real offset[NY] = @offset@;

void @name@_reset(@name@_state *state)
{
    int i, j;
    for (i = 0; i < NT; i++) {
        state->theta[i] = first_estimate[i];
        for (j = 0; j < NT; j++) {
            state->covariance[i][j] = first_covariance[i][j];
        }
    }
    state->begun = 0;
}

static void predict(@name@_state *state, const real u_prev[NU])
{
    real moved[NT], product[NT][NT];
    int i, j, k;
    for (i = 0; i < NT; i++) {
        moved[i] = drift[i];
        for (j = 0; j < NT; j++) {
            moved[i] += state_matrix[i][j] * state->theta[j];
            product[i][j] = 0;
            for (k = 0; k < NT; k++) {
                product[i][j] += state_matrix[i][k] * state->covariance[k][j];
            }
        }
        for (j = 0; j < NU; j++) {
            moved[i] += input_matrix[i][j] * u_prev[j];
        }
    }
    for (i = 0; i < NT; i++) {
        state->theta[i] = moved[i];
        for (j = 0; j <= i; j++) {
            real sum = process_noise[i][j];
            for (k = 0; k < NT; k++) {
                sum += product[i][k] * state_matrix[j][k];
            }
            state->covariance[i][j] = sum;
            state->covariance[j][i] = sum;
        }
    }
}

int @name@_step(@name@_state *state, const real y[NY], const real u_prev[NU], real u[NU])
{
    int i, j, k;
    if (state->begun) {
        predict(state, u_prev);
    }
    state->begun = 1;
    for (k = 0; k < NY; k++) { /* outputs of independent noise, one by one */
        real missed = -offset[k], variance = 1, column[NT];
        for (j = 0; j < NY; j++) {
            missed += scale[k][j] * y[j];
        }
        for (j = 0; j < NU; j++) {
            missed -= through[k][j] * u_prev[j];
        }
        for (i = 0; i < NT; i++) {
            missed -= seen[k][i] * state->theta[i];
            column[i] = 0;
            for (j = 0; j < NT; j++) {
                column[i] += state->covariance[i][j] * seen[k][j];
            }
            variance += seen[k][i] * column[i];
        }
        for (i = 0; i < NT; i++) {
            state->theta[i] += column[i] * missed / variance;
            for (j = 0; j < NT; j++) {
                state->covariance[i][j] -= column[i] * column[j] / variance;
            }
        }
    }
    return @name@_law(state->theta, u);
}
"""


def filter_fields(estimator: Any, scalar: str) -> dict[str, Any]:
    """Fields of both templates, of a `KalmanFilter`."""
    white = np.linalg.inv(np.linalg.cholesky(estimator.V))
    P0 = estimator.predicted if estimator.steady else estimator.P0
    tables = {
        "A": estimator.A, "B": estimator.B, "c": estimator.c, "W": estimator.W, "x0": estimator.x0, "P0": P0,
        "scale": white, "seen": white @ estimator.C, "through": white @ estimator.D, "offset": white @ estimator.y0,
    }  # fmt: skip
    return {name: table(values, scalar) for name, values in tables.items()} | {"ny": estimator.ny}
