"""C99 source of a Kalman filter, extended or not, the memory of a policy of its estimate."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.exceptions import InputError
from ccdtools.plants.casadi_arrays import Vectorised
from ccdtools.plants.casadi_operations import c_operations
from mpc.explicit.codegen.c_source import real, table

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
#include <math.h>

#define NY @NAME@_NY
#define PARTS @parts@ /* of a sample */

static const real process_noise[NT][NT] = @W@;
static const real drift[NT] = @c@; /* of a sample */
static const real first_estimate[NT] = @x0@;
static const real first_covariance[NT][NT] = @P0@;

/* the state after a part of a sample, and its slope by the state, by rows */
static void advance(const real x[NT], const real u[NU], real after[NT], real slope[NT * NT])
{
@advance@
}

/* outputs less what is expected of a state, in units of their noise; slope of the latter by the state, by rows */
static void compare(const real x[NT], const real u[NU], const real y[NY], real rest[NY], real slope[NY * NT])
{
@compare@
}

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
    real after[NT], slope[NT * NT], product[NT][NT];
    int i, j, k, part;
    for (part = 0; part < PARTS; part++) {
        advance(state->theta, u_prev, after, slope);
        for (i = 0; i < NT; i++) {
            state->theta[i] = part < PARTS - 1 ? after[i] : after[i] + drift[i];
            for (j = 0; j < NT; j++) {
                product[i][j] = 0;
                for (k = 0; k < NT; k++) {
                    product[i][j] += slope[i * NT + k] * state->covariance[k][j];
                }
            }
        }
        for (i = 0; i < NT; i++) {
            for (j = 0; j <= i; j++) {
                real sum = part < PARTS - 1 ? 0 : process_noise[i][j];
                for (k = 0; k < NT; k++) {
                    sum += product[i][k] * slope[j * NT + k];
                }
                state->covariance[i][j] = sum;
                state->covariance[j][i] = sum;
            }
        }
    }
}

int @name@_step(@name@_state *state, const real y[NY], const real u_prev[NU], real u[NU])
{
    real rest[NY], slope[NY * NT], moved[NT] = {0};
    int i, j, k;
    if (state->begun) {
        predict(state, u_prev);
    }
    state->begun = 1;
    compare(state->theta, u_prev, y, rest, slope);
    for (k = 0; k < NY; k++) { /* outputs of independent noise, one by one */
        real missed = rest[k], variance = 1, column[NT];
        for (i = 0; i < NT; i++) {
            missed -= slope[k * NT + i] * moved[i];
            column[i] = 0;
            for (j = 0; j < NT; j++) {
                column[i] += state->covariance[i][j] * slope[k * NT + j];
            }
            variance += slope[k * NT + i] * column[i];
        }
        for (i = 0; i < NT; i++) {
            moved[i] += column[i] * missed / variance;
            for (j = 0; j < NT; j++) {
                state->covariance[i][j] -= column[i] * column[j] / variance;
            }
        }
    }
    for (i = 0; i < NT; i++) {
        state->theta[i] += moved[i];
    }
    return @name@_law(state->theta, u);
}
"""


def filter_fields(estimator: Any, scalar: str) -> dict[str, Any]:
    """Fields of both templates, of a filter of expressions."""
    plant = estimator.expressed()
    x, u, y, none = plant.x, plant.u, ca.SX.sym("y", plant.ny), ca.SX(0, 1)
    step = plant.explicit_step
    after = step.substep(x, u, none, none)
    white = ca.DM(np.linalg.inv(np.linalg.cholesky(estimator.V)))
    seen = white @ plant.outputs
    start = estimator.start(1)
    P0 = start.covariance.reshape(plant.nx, plant.nx)
    tables = {"W": estimator.W, "c": estimator.c, "x0": start.mean[0], "P0": P0}
    return {name: table(values, scalar) for name, values in tables.items()} | {
        "ny": plant.ny, "parts": step.substeps,
        "advance": _body([x, u], {"after": after, "slope": ca.jacobian(after, x).T}, scalar),
        "compare": _body([x, u, y], {"rest": white @ y - seen, "slope": ca.jacobian(seen, x).T}, scalar),
    }  # fmt: skip


def _number(value: float, scalar: str) -> str:
    """C text of a number, which may be infinite."""
    return real(value, scalar) if math.isfinite(value) else ("-INFINITY" if value < 0 else "INFINITY")


def _body(given: list[ca.SX], results: dict[str, ca.SX], scalar: str) -> str:
    """C text that writes expressions in x, u and y to arrays."""
    f = ca.Function("f", given, [ca.vec(ca.densify(value)) for value in results.values()], {"cse": True})
    try:
        lines, values = Vectorised(f, "estimator").lines(
            ["x[{}]", "u[{}]", "y[{}]"], c_operations(scalar), "const real {} = {};", partial(_number, scalar=scalar)
        )
    except KeyError as error:
        raise InputError("estimator", f"operation {error} of CasADi", "operations that C99 has") from None
    lines += [f"{name}[{i}] = {value};" for name, row in zip(results, values) for i, value in enumerate(row)]
    unused = " ".join(f"(void){name};" for name, _ in zip("xuy", given))
    return "\n".join(f"    {line}" for line in [*lines, unused])
