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
from ccdtools_ground.operations import bent_rows
from mpc.explicit.codegen.c_source import fill, real, table

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
#define NZ (NT + @nw@) /* with the disturbance */

static const real process_noise[NT * NT] = @W@;
static const real output_noise[NY * NY] = @V@;
static const real drift[NT] = @c@; /* of a sample */
static const real first_estimate[NT] = @x0@;
static const real first_covariance[NT][NT] = @P0@;
@tools@@advance@@observe@
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
    real after[NT], with_state[NT * NT], own[NT * NT];
    int i, j;
    advance(state->theta, state->covariance, u_prev, after, with_state, own);
    for (i = 0; i < NT; i++) {
        state->theta[i] = after[i] + drift[i];
        for (j = 0; j < NT; j++) {
            state->covariance[i][j] = own[i * NT + j] + process_noise[i * NT + j];
        }
    }
}

int @name@_step(@name@_state *state, const real y[NY], const real u_prev[NU], real u[NU])
{
    real seen[NY], with_state[NY * NT], own[NY * NY];
    int i, j, k;
    if (state->begun) {
        predict(state, u_prev);
    }
    state->begun = 1;
    observe(state->theta, state->covariance, u_prev, seen, with_state, own);
    for (k = 0; k < NY * NY; k++) {
        own[k] += output_noise[k];
    }
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
/* lower root of a covariance to all that counts, and the share to which a column does; returns the sum of these, at
   least one */
static real root_of(int n, const real *P, real *root, real *share)
{
    real count = 0;
    int i, j, k;
    for (j = 0; j < n; j++) {
        real pivot = 0;
        for (i = 0; i < n; i++) {
            real sum = i < j ? 0 : P[i * n + j];
            for (k = 0; i >= j && k < j; k++) {
                sum -= root[i * n + k] * root[j * n + k];
            }
            if (i == j && P[j * n + j] > 0) {
                sum = @hypot@(sum, @negligible@ * P[j * n + j]);
                pivot = @sqrt@(sum);
            }
            root[i * n + j] = pivot > 0 ? sum / pivot : 0;
        }
        share[j] = 0;
        for (i = j; i < n; i++) { /* of the variance of each state */
            share[j] += P[i * n + i] > 0 ? root[i * n + j] * root[i * n + j] / (@small@ * P[i * n + i]) : 0;
        }
        share[j] = share[j] < 1 ? share[j] * share[j] * (3 - 2 * share[j]) : 1;
        count += share[j];
    }
    return count > 1 ? count : 1;
}
"""

HELD = """static const real held[@some@] = @mean@; /* mean of the disturbance, and its covariance */
static const real held_noise[@some@][@some@] = @S@;
"""

SAMPLE = """
static void part_of(const real z[NZ], const real u[NU], real value[NT])
{
@body@
}

static void advance_of(const real z[NZ], const real u[NU], real value[NT])
{
    real before[NZ];
    int i, part;
    part_of(z, u, value);
    for (part = 1; part < @parts@; part++) {
        for (i = 0; i < NZ; i++) {
            before[i] = i < NT ? value[i] : z[i];
        }
        part_of(before, u, value);
    }
}
"""

OUTPUT = """
static void observe_of(const real z[NT], const real u[NU], real value[NY])
{
@body@
}
"""

CUBATURE = """
/* mean of a function over cubature points of a belief, and its covariances with the state and with itself */
static void @f@(const real x[NT], real P[NT][NT], const real u[NU], real mean[@m@], real with_state[@m@ * NT],
                real own[@m@ * @m@])
{
    real both[@n@ * @n@], root[@n@ * @n@], centre[@n@], point[@n@], up[@n@][@m@], down[@n@][@m@], slope[@m@ * @n@];
    real share[@n@], count, far;
    int i, j, k;
    for (i = 0; i < @n@; i++) {
        centre[i] = i < NT ? x[i] : held[i - NT];
        for (j = 0; j < @n@; j++) {
            both[i * @n@ + j] = i < NT && j < NT ? P[i][j] : i < NT || j < NT ? 0 : held_noise[i - NT][j - NT];
        }
    }
    count = root_of(@n@, both, root, share);
    far = @sqrt@(count);
    for (j = 0; j < @n@; j++) {
        for (i = 0; i < @n@; i++) {
            point[i] = centre[i] + far * root[i * @n@ + j];
        }
        @f@_of(point, u, up[j]);
        for (i = 0; i < @n@; i++) {
            point[i] = centre[i] - far * root[i * @n@ + j];
        }
        @f@_of(point, u, down[j]);
    }
    for (i = 0; i < @m@; i++) {
        mean[i] = up[0][i];
        for (j = 0; j < @n@; j++) {
            mean[i] += share[j] * ((up[j][i] + down[j][i]) / 2 - up[0][i]) / count;
        }
        for (j = @n@ - 1; j >= 0; j--) { /* the slope times the root are the differences */
            real rest = (up[j][i] - down[j][i]) / (2 * far);
            for (k = j + 1; k < @n@; k++) {
                rest -= slope[i * @n@ + k] * root[k * @n@ + j];
            }
            slope[i * @n@ + j] = root[j * @n@ + j] > 0 ? rest / root[j * @n@ + j] : 0;
        }
        for (k = 0; k <= i; k++) { /* what the slope misses */
            real sum = 0;
            for (j = 0; j < @n@; j++) {
                const real even = (up[j][i] + down[j][i]) / 2 - mean[i], other = (up[j][k] + down[j][k]) / 2 - mean[k];
                sum += share[j] * even * other / count;
            }
            own[i * @m@ + k] = sum;
        }
    }
    through(@m@, @n@, slope, both, with_state, own);
}
"""

LINEAR = """
/* value of a linear function of a belief, and its covariances with the state and with itself */
static void @f@(const real x[NT], real P[NT][NT], const real u[NU], real mean[@m@], real with_state[@m@ * NT],
                real own[@m@ * @m@])
{
    real slope[@m@ * NT];
@body@
    through(@m@, NT, slope, &P[0][0], with_state, own);
}
"""

THROUGH = """
/* covariances of a value with the state and with itself, by its slope and by what that misses, in `own` */
static void through(int m, int n, const real *slope, const real *P, real *with_state, real *own)
{
    int i, j, k;
    for (i = 0; i < m; i++) {
        for (j = 0; j < n; j++) {
            real sum = 0;
            for (k = 0; k < n; k++) {
                sum += slope[i * n + k] * P[k * n + j];
            }
            for (k = 0; k <= i; k++) {
                own[i * m + k] += sum * slope[k * n + j];
            }
            if (j < NT) {
                with_state[i * NT + j] = sum;
            }
        }
        for (k = 0; k < i; k++) {
            own[k * m + i] = own[i * m + k];
        }
    }
}
"""


def filter_fields(estimator: Any, scalar: str) -> dict[str, Any]:
    """Fields of both templates, of a filter of expressions."""
    plant, (mean, S) = estimator.expressed(), estimator.disturbance
    x, u, w, none = plant.x, plant.u, plant.w, ca.SX(0, 1)
    z, nw = ca.vertcat(x, w), plant.nw
    step = plant.explicit_step
    start = estimator.start(1)
    P0 = start.covariance.reshape(plant.nx, plant.nx)
    room = np.zeros((max(nw, 1), max(nw, 1)))  # C has no empty tables
    room[:nw, :nw] = S
    tables = {"W": estimator.W.ravel(), "V": estimator.V.ravel(), "c": estimator.c, "x0": start.mean[0], "P0": P0}
    one = {name: f"{name}f" if scalar == "float" else name for name in ("sqrt", "hypot")} | {"parts": step.substeps}
    each = {
        "advance": ("NT", "NZ", z, step.function(x, u, w, none), SAMPLE, step.substep(x, u, w, none)),
        "observe": ("NY", "NT", x, plant.outputs, OUTPUT, plant.outputs),
    }
    found = {}
    for f, (m, n, of, whole, template, value) in each.items():
        slope = ca.jacobian(whole, of)
        if bent_rows(whole, of):
            text, body = template + CUBATURE, _body([of, u], {"value": value}, ["z[{}]", "u[{}]"], scalar)
        else:
            H, G = ca.horzsplit(slope, [0, plant.nx, slope.shape[1]])
            own = G @ ca.DM(S)[: G.shape[1], : G.shape[1]] @ G.T
            results = {"mean": ca.substitute(whole, w, ca.DM(mean)), "slope": H.T, "own": own}
            text, body = LINEAR, _body([x, u], results, ["x[{}]", "u[{}]"], scalar)
        found[f] = fill(text, one | {"f": f, "m": m, "n": n, "body": body})
    eps = float(np.finfo(np.float32 if scalar == "float" else float).eps)
    held = {"some": len(room), "mean": table(np.append(mean, room[0, nw:]), scalar), "S": table(room, scalar)}
    needed = THROUGH + (HELD + ROOT) * ("root_of" in "".join(found.values()))
    small = {"negligible": real(eps ** (2 / 3), scalar), "small": real(eps ** (1 / 3), scalar)}
    tools = fill(needed, one | held | small)
    texts = {name: table(values, scalar) for name, values in tables.items()}
    return texts | found | {"ny": plant.ny, "nw": nw, "tools": tools}


def _number(value: float, scalar: str) -> str:
    """C text of a number, which may be infinite."""
    return real(value, scalar) if math.isfinite(value) else ("-INFINITY" if value < 0 else "INFINITY")


def _body(given: list[ca.SX], results: dict[str, ca.SX], names: list[str], scalar: str) -> str:
    """C text that writes expressions in given names to arrays."""
    f = ca.Function("f", given, [ca.vec(ca.densify(value)) for value in results.values()], {"cse": True})
    try:
        lines, values = Vectorised(f, "estimator").lines(
            names, c_operations(scalar), "const real {} = {};", partial(_number, scalar=scalar)
        )
    except KeyError as error:
        raise InputError("estimator", f"operation {error} of CasADi", "operations that C99 has") from None
    lines += [f"{name}[{i}] = {value};" for name, row in zip(results, values) for i, value in enumerate(row)]
    unused = " ".join(f"(void){name[0]};" for name in names)
    return "\n".join(f"    {line}" for line in [*lines, unused])
