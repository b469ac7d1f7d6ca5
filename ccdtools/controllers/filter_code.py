"""C99 source of a Kalman filter, by cubature points or linear, the memory of a policy of its estimate."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from ccdtools.exceptions import InputError
from ccdtools.plants.casadi_arrays import Vectorised
from ccdtools.plants.casadi_operations import c_operations
from mpc.explicit.codegen.c_source import fill, real, table
from mpc.tolerances import ROUNDED_SUM

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

static const real process_noise[NT * NT] = @W@;
static const real output_noise[NY * NY] = @V@;
static const real drift[NT] = @c@; /* of a sample */
static const real first_estimate[NT] = @x0@;
static const real first_covariance[NT][NT] = @P0@;
@root@@advance@@observe@
/* covariances (m, NT) and (m, m) of a function of a state with it, and with itself, from slope (m, NT) and noise */
static void spread(int m, real P[NT][NT], const real *slope, const real *missed, const real *noise, real *with_state,
                   real *own)
{
    int i, j, k;
    for (i = 0; i < m; i++) {
        for (j = 0; j < NT; j++) {
            with_state[i * NT + j] = 0;
            for (k = 0; k < NT; k++) {
                with_state[i * NT + j] += slope[i * NT + k] * P[k][j];
            }
        }
        for (j = 0; j <= i; j++) {
            real sum = missed[i * m + j] + noise[i * m + j];
            for (k = 0; k < NT; k++) {
                sum += with_state[i * NT + k] * slope[j * NT + k];
            }
            own[i * m + j] = sum;
            own[j * m + i] = sum;
        }
    }
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
    real after[NT], slope[NT * NT], missed[NT * NT], with_state[NT * NT], own[NT * NT];
    int i, j;
    advance(state->theta, state->covariance, u_prev, after, slope, missed);
    spread(NT, state->covariance, slope, missed, process_noise, with_state, own);
    for (i = 0; i < NT; i++) {
        state->theta[i] = after[i] + drift[i];
        for (j = 0; j < NT; j++) {
            state->covariance[i][j] = own[i * NT + j];
        }
    }
}

int @name@_step(@name@_state *state, const real y[NY], const real u_prev[NU], real u[NU])
{
    real seen[NY], slope[NY * NT], missed[NY * NY], with_state[NY * NT], own[NY * NY];
    int i, j, k;
    if (state->begun) {
        predict(state, u_prev);
    }
    state->begun = 1;
    observe(state->theta, state->covariance, u_prev, seen, slope, missed);
    spread(NY, state->covariance, slope, missed, output_noise, with_state, own);
    for (k = 0; k < NY; k++) { /* outputs one by one, given those before */
        const real *column = with_state + k * NT, *row = own + k * NY;
        const real rest = (y[k] - seen[k]) / row[k];
        for (i = 0; i < NT; i++) {
            state->theta[i] += column[i] * rest;
            for (j = 0; j < NT; j++) {
                state->covariance[i][j] -= column[i] * column[j] / row[k];
            }
        }
        for (i = k + 1; i < NY; i++) {
            const real part = row[i] / row[k];
            seen[i] += row[i] * rest;
            for (j = 0; j < NT; j++) {
                with_state[i * NT + j] -= part * column[j];
            }
            for (j = k + 1; j < NY; j++) {
                own[i * NY + j] -= part * row[j];
            }
        }
    }
    return @name@_law(state->theta, u);
}
"""

ROOT = """
/* lower root of a covariance, with columns of zeros along what is known; returns how many others there are */
static int root_of(real P[NT][NT], real root[NT][NT])
{
    int i, j, k, count = 0;
    for (j = 0; j < NT; j++) {
        real pivot = 0;
        for (i = 0; i < NT; i++) {
            real sum = i < j ? 0 : P[i][j];
            for (k = 0; k < j; k++) {
                sum -= i < j ? 0 : root[i][k] * root[j][k];
            }
            pivot = i == j && sum > @rounding@ * P[j][j] ? @sqrt@(sum) : pivot;
            root[i][j] = pivot > 0 ? sum / pivot : 0;
        }
        count += pivot > 0;
    }
    return count;
}
"""

SAMPLE = """
static void part_of(const real x[NT], const real u[NU], real value[NT])
{
@body@
}

static void advance_of(const real x[NT], const real u[NU], real value[NT])
{
    real before[NT];
    int i, part;
    part_of(x, u, value);
    for (part = 1; part < @parts@; part++) {
        for (i = 0; i < NT; i++) {
            before[i] = value[i];
        }
        part_of(before, u, value);
    }
}
"""

OUTPUT = """
static void observe_of(const real x[NT], const real u[NU], real value[NY])
{
@body@
}
"""

CUBATURE = """
/* mean of a function over a belief, its slope by least squares over cubature points, and the covariance that misses */
static void @f@(const real x[NT], real P[NT][NT], const real u[NU], real mean[@m@], real slope[@m@ * NT],
                real missed[@m@ * @m@])
{
    real root[NT][NT], point[NT], up[NT][@m@], down[NT][@m@];
    const int unknown = root_of(P, root);
    const real count = (real)(unknown > 0 ? unknown : 1), far = @sqrt@(count);
    int i, j, k;
    for (j = 0; j < NT; j++) {
        for (i = 0; i < NT; i++) {
            point[i] = x[i] + far * root[i][j];
        }
        @f@_of(point, u, up[j]);
        for (i = 0; i < NT; i++) {
            point[i] = x[i] - far * root[i][j];
        }
        @f@_of(point, u, down[j]);
    }
    for (i = 0; i < @m@; i++) {
        mean[i] = up[0][i];
        for (j = 0; j < NT; j++) {
            mean[i] += root[j][j] > 0 ? ((up[j][i] + down[j][i]) / 2 - up[0][i]) / count : 0;
        }
        for (j = NT - 1; j >= 0; j--) {
            real rest = (up[j][i] - down[j][i]) / (2 * far);
            for (k = j + 1; k < NT; k++) {
                rest -= slope[i * NT + k] * root[k][j];
            }
            slope[i * NT + j] = root[j][j] > 0 ? rest / root[j][j] : 0;
        }
    }
    for (i = 0; i < @m@; i++) {
        for (k = 0; k < @m@; k++) {
            missed[i * @m@ + k] = 0;
            for (j = 0; j < NT; j++) {
                const real left = (up[j][i] + down[j][i]) / 2 - mean[i], other = (up[j][k] + down[j][k]) / 2 - mean[k];
                missed[i * @m@ + k] += root[j][j] > 0 ? left * other / count : 0;
            }
        }
    }
}
"""

LINEAR = """
/* value of a linear function, its slope, and the covariance that the slope misses */
static void @f@(const real x[NT], real P[NT][NT], const real u[NU], real mean[@m@], real slope[@m@ * NT],
                real missed[@m@ * @m@])
{
    int i;
@body@
    for (i = 0; i < @m@ * @m@; i++) {
        missed[i] = 0;
    }
    (void)P;
}
"""


def filter_fields(estimator: Any, scalar: str) -> dict[str, Any]:
    """Fields of both templates, of a filter of expressions."""
    plant = estimator.expressed()
    x, u, none = plant.x, plant.u, ca.SX(0, 1)
    step = plant.explicit_step
    start = estimator.start(1)
    P0 = start.covariance.reshape(plant.nx, plant.nx)
    tables = {"W": estimator.W.ravel(), "V": estimator.V.ravel(), "c": estimator.c, "x0": start.mean[0], "P0": P0}
    one = {"sqrt": "sqrtf" if scalar == "float" else "sqrt", "parts": step.substeps}
    each = {
        "advance": ("NT", step.function(x, u, none, none), SAMPLE, step.substep(x, u, none, none)),
        "observe": ("NY", plant.outputs, OUTPUT, plant.outputs),
    }
    found = {}
    for f, (m, whole, template, value) in each.items():
        slope = ca.jacobian(whole, x)
        if ca.depends_on(slope, x):
            text, body = template + CUBATURE, _body([x, u], {"value": value}, scalar)
        else:
            text, body = LINEAR, _body([x, u], {"mean": whole, "slope": slope.T}, scalar)
        found[f] = fill(text, one | {"f": f, "m": m, "body": body})
    rounding = ROUNDED_SUM / np.finfo(float).eps * np.finfo(np.float32 if scalar == "float" else float).eps
    root = fill(ROOT, one | {"rounding": real(rounding, scalar)}) if "root_of" in "".join(found.values()) else ""
    return {name: table(values, scalar) for name, values in tables.items()} | found | {"ny": plant.ny, "root": root}


def _number(value: float, scalar: str) -> str:
    """C text of a number, which may be infinite."""
    return real(value, scalar) if math.isfinite(value) else ("-INFINITY" if value < 0 else "INFINITY")


def _body(given: list[ca.SX], results: dict[str, ca.SX], scalar: str) -> str:
    """C text that writes expressions in x and u to arrays."""
    f = ca.Function("f", given, [ca.vec(ca.densify(value)) for value in results.values()], {"cse": True})
    try:
        lines, values = Vectorised(f, "estimator").lines(
            ["x[{}]", "u[{}]"], c_operations(scalar), "const real {} = {};", partial(_number, scalar=scalar)
        )
    except KeyError as error:
        raise InputError("estimator", f"operation {error} of CasADi", "operations that C99 has") from None
    lines += [f"{name}[{i}] = {value};" for name, row in zip(results, values) for i, value in enumerate(row)]
    unused = " ".join(f"(void){name};" for name, _ in zip("xu", given))
    return "\n".join(f"    {line}" for line in [*lines, unused])
