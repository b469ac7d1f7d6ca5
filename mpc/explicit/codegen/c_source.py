"""The C text that `codegen` fills in, and the printing of its tables."""

from __future__ import annotations

from typing import Any

import numpy as np

HEADER = """\
/* Explicit model predictive control: @summary@. Generated; do not edit. */
#ifndef @NAME@_H
#define @NAME@_H

#define @NAME@_NT @nt@ /* parameters */
#define @NAME@_NU @nu@ /* inputs */

typedef @scalar@ @name@_real;

/* Write the input that belongs to theta into u.
   Returns 0; 1 where theta is outside the partition (u: the law of a region near by, saturated);
   2 where theta is not finite (u: zero). */
int @name@_law(const @name@_real theta[@NAME@_NT], @name@_real u[@NAME@_NU]);

#endif
"""

SOURCE = """\
/* Explicit model predictive control: @summary@. Generated; do not edit. */
#include "@name@.h"

#include <float.h>
#include <stdint.h>

#define NT @NAME@_NT
#define NU @NAME@_NU
#define TOLERANCE @tolerance@

typedef @name@_real real;

@law@
static const real lowest[NU] = @low@;
static const real highest[NU] = @high@;

/* a'theta - b of a hyperplane [a, b] */
static real distance(const real plane[NT + 1], const real theta[NT])
{
    real sum = 0;
    int j;
    for (j = 0; j < NT; j++) {
        sum += plane[j] * theta[j];
    }
    return sum - plane[NT];
}

@body@
int @name@_law(const real theta[NT], real u[NU])
{
    int i, j, k, outside = 0;
    for (j = 0; j < NT; j++) {
        if (!(theta[j] >= -@largest@ && theta[j] <= @largest@)) {
            for (i = 0; i < NU; i++) {
                u[i] = 0;
            }
            return 2;
        }
    }
    k = find_law(theta, &outside);
    for (i = 0; i < NU; i++) {
        u[i] = apply(k, i, theta);
        if (outside && !(u[i] <= highest[i])) {
            u[i] = highest[i];
        }
        if (outside && !(u[i] >= lowest[i])) {
            u[i] = lowest[i];
        }
    }
    return outside;
}
"""

LAW_DOUBLE = """\
/* u = laws[k][.][NT] + laws[k][.][0..NT-1] (theta - points[k]): near its point a law loses no digits */
static const real laws[@nlaws@][NU][NT + 1] = @laws@;
static const real points[@nlaws@][NT] = @points@;

static real apply(int k, int i, const real theta[NT])
{
    real sum = 0;
    int j;
    for (j = 0; j < NT; j++) {
        sum += laws[k][i][j] * (theta[j] - points[k][j]);
    }
    return sum + laws[k][i][NT];
}
"""

LAW_FLOAT = """\
/* u = (laws + rests)[k][.][0..NT-1] theta + (laws + rests)[k][.][NT] */
static const real laws[@nlaws@][NU][NT + 1] = @laws@;
static const real rests[@nlaws@][NU][NT + 1] = @rests@;

/* what rounding took from the product a b (Dekker, 1971); do not compile with -ffast-math */
static real lost(real a, real b, real product)
{
    const real ca = 4097.0f * a, cb = 4097.0f * b;
    const real ah = ca - (ca - a), bh = cb - (cb - b);
    const real al = a - ah, bl = b - bh;
    return ((ah * bh - product) + ah * bl + al * bh) + al * bl;
}

/* dot product in twice the precision (Ogita, Rump and Oishi, 2005): the terms of a law can be far larger than u */
static real apply(int k, int i, const real theta[NT])
{
    real sum = laws[k][i][NT], rest = rests[k][i][NT];
    int j;
    for (j = 0; j < NT; j++) {
        const real product = laws[k][i][j] * theta[j];
        const real next = sum + product, part = next - sum;
        rest += lost(laws[k][i][j], theta[j], product) + rests[k][i][j] * theta[j];
        rest += (sum - (next - part)) + (product - part);
        sum = next;
    }
    return sum + rest;
}
"""

TREE = """\
/* inner nodes: go below where planes[plane] is <= 0; a negative child is the law -1 - child */
static const real planes[@nplanes@][NT + 1] = @planes@;
static const @int@ node_plane[@nnodes@] = @plane@;
static const @int@ node_below[@nnodes@] = @below@;
static const @int@ node_above[@nnodes@] = @above@;
/* the partition lies where all of these are <= 0 */
static const real border[@nborder@][NT + 1] = @border@;

static int find_law(const real theta[NT], int *outside)
{
    int i, node = @root@;
    for (i = 0; i < @nborder@; i++) {
        if (!(distance(border[i], theta) <= TOLERANCE)) {
            *outside = 1;
            break;
        }
    }
    while (node >= 0) {
        node = distance(planes[node_plane[node]], theta) <= 0 ? node_below[node] : node_above[node];
    }
    return -1 - node;
}
"""

SEQUENTIAL = """\
/* region r lies where all planes rows[start[r]] ... rows[start[r + 1] - 1] are <= 0; -1 - i means minus plane i */
static const real planes[@nplanes@][NT + 1] = @planes@;
static const @int@ start[@nregions@ + 1] = @start@;
static const @int@ rows[@nrows@] = @rows@;
static const @int@ law_of[@nregions@] = @law@;

static int find_law(const real theta[NT], int *outside)
{
    int r, i, best = 0;
    real least = @largest@;
    for (r = 0; r < @nregions@; r++) {
        real worst = -@largest@;
        for (i = start[r]; i < start[r + 1]; i++) {
            const int row = rows[i];
            const real d = row >= 0 ? distance(planes[row], theta) : -distance(planes[-1 - row], theta);
            if (d > worst) {
                worst = d;
            }
            if (worst >= least) {
                break;
            }
        }
        if (worst < least) {
            least = worst;
            best = r;
        }
        if (least <= 0) {
            break;
        }
    }
    *outside = !(least <= TOLERANCE);
    return law_of[best];
}
"""


def real(value: float, scalar: str) -> str:
    """A number that reads back exactly, as a C literal."""
    if scalar == "double":
        return repr(float(value))
    text = f"{float(np.float32(value)):.9g}"
    return text + ("f" if "." in text or "e" in text else ".0f")


def table(values: Any, scalar: str) -> str:
    """A nested C initialiser; an empty table gets one zero, which C demands."""
    array = np.asarray(values)
    if array.size == 0:
        return "{0}" if array.ndim == 1 else "{{0}}"
    if array.ndim > 1:
        return "{\n" + ",\n".join(table(part, scalar) for part in array) + "}"
    if scalar in ("double", "float"):
        return "{" + ", ".join(real(v, scalar) for v in array) + "}"
    lines = [", ".join(str(int(v)) for v in array[i : i + 20]) for i in range(0, len(array), 20)]
    return "{" + ",\n".join(lines) + "}"
