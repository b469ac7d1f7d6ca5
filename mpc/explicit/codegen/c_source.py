"""C templates of `codegen`, their tables, and the files that they fill."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from mpc.exceptions import InputError

SIZES = {"double": 8, "float": 4, "int16_t": 2, "int32_t": 4}  # [B]
LARGEST = {"double": "DBL_MAX", "float": "FLT_MAX"}

HEADER = """\
/* @what@: @summary@. Generated; do not edit. */
#ifndef @NAME@_H
#define @NAME@_H

#define @NAME@_NT @nt@ /* parameters */
#define @NAME@_NU @nu@ /* inputs */

typedef @scalar@ @name@_real;

/* Write the input that belongs to theta into u.
   Returns 0; @outside@2 where theta is not finite (u: the input nearest to zero). */
int @name@_law(const @name@_real theta[@NAME@_NT], @name@_real u[@NAME@_NU]);

#endif
"""

OUTSIDE = {  # of a partition that is complete, or not
    True: """1 where theta is outside the partition (u: the input where the straight line to an inner point enters it);
   """,
    False: """1 where theta is outside the partition (u: the law of the nearest region, saturated);
   """,
}

SOURCE = """\
/* @what@: @summary@. Generated; do not edit. */
#include "@name@.h"

#include <float.h>
#include <stdint.h>

#define NT @NAME@_NT
#define NU @NAME@_NU
#define TOLERANCE @tolerance@
#define LARGE @large@

typedef @name@_real real;

@law@
static const real lowest[NU] = @low@;
static const real highest[NU] = @high@;
static const real nearest[NU] = @nearest@; /* to zero, of all inputs */

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

@border@
@regions@
@body@
int @name@_law(const real theta[NT], real u[NU])
{
    real point[NT];
    int i, j, k, outside;
    for (j = 0; j < NT; j++) {
        if (!(theta[j] >= -@largest@ && theta[j] <= @largest@)) {
            for (i = 0; i < NU; i++) {
                u[i] = nearest[i];
            }
            return 2;
        }
        point[j] = theta[j];
    }
    outside = pull_back(point);
    k = find_law(point, &outside);
    for (i = 0; i < NU; i++) {
        u[i] = apply(k, i, point);
        if (!(u[i] <= highest[i])) {
            u[i] = highest[i];
        }
        if (!(u[i] >= lowest[i])) {
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

BORDER = """\
/* the partition lies where all of these are <= 0 */
static const real border[@nborder@][NT + 1] = @border@;
static const real room[@nborder@] = @room@; /* minus their values at the point inner */
static const real inner[NT] = @inner@;
static const real half[NT] = @half@;

/* move a point beyond the border towards inner until it is on it; 1 if it was beyond */
static int pull_back(real theta[NT])
{
    real way[NT], far = 0, share = 1;
    int i, j, beyond = 0;
    for (i = 0; i < @nborder@ && !beyond; i++) {
        beyond = !(distance(border[i], theta) <= TOLERANCE);
    }
    if (!beyond) {
        return 0;
    }
    for (j = 0; j < NT; j++) {
        way[j] = (theta[j] - inner[j]) / half[j];
        way[j] = way[j] > LARGE ? LARGE : way[j] < -LARGE ? -LARGE : way[j];
        far = way[j] > far ? way[j] : -way[j] > far ? -way[j] : far;
    }
    for (j = 0; j < NT; j++) {
        way[j] *= half[j] * (far > 2 ? 2 / far : 1);
    }
    for (i = 0; i < @nborder@; i++) {
        real step = 0;
        for (j = 0; j < NT; j++) {
            step += border[i][j] * way[j];
        }
        if (step * share > room[i]) {
            share = room[i] / step;
        }
    }
    for (j = 0; j < NT; j++) {
        theta[j] = inner[j] + share * way[j];
    }
    return 1;
}
"""

NO_BORDER = """\
/* the partition is incomplete: what lies in no region is outside */
static int pull_back(const real theta[NT])
{
    (void)theta;
    return 0;
}
"""

REGIONS = """\
static const real planes[@nplanes@][NT + 1] = @planes@;
"""

SCAN = """\
/* region r lies where all planes rows[start[r]] ... rows[start[r + 1] - 1] are <= 0; -1 - i means minus plane i */
static const @int@ start[@nregions@ + 1] = @start@;
static const @int@ rows[@nrows@] = @rows@;
static const @int@ law_of[@nregions@] = @law@;

/* law of the region that holds theta or is nearest to it, and how far theta is outside of it */
static int scan(const real theta[NT], int first, int end, real *least)
{
    int e, i, best = 0;
    *least = @largest@;
    for (e = first; e < end && *least > 0; e++) {
        const int r = @which@;
        real worst = -@largest@;
        for (i = start[r]; i < start[r + 1] && worst < *least; i++) {
            const int row = rows[i];
            const real d = row >= 0 ? distance(planes[row], theta) : -distance(planes[-1 - row], theta);
            worst = d > worst ? d : worst;
        }
        if (worst < *least) {
            *least = worst;
            best = r;
        }
    }
    return law_of[best];
}
"""

TREE = """\
/* inner nodes: go below where planes[plane] is <= 0; a negative child is the leaf -1 - child */
static const @int@ node_plane[@nnodes@] = @plane@;
static const @int@ node_below[@nnodes@] = @below@;
static const @int@ node_above[@nnodes@] = @above@;
@lists@
static int find_law(const real theta[NT], int *outside)
{
    int node = @root@;
    (void)outside;
    while (node >= 0) {
        node = distance(planes[node_plane[node]], theta) <= 0 ? node_below[node] : node_above[node];
    }
    node = -1 - node;
@leaf@
}
"""

LISTS = """\
/* leaf @nlaws@ + l holds the regions members[lists[l]] ... members[lists[l + 1] - 1], of several laws */
static const @int@ lists[@nlists@ + 1] = @list_start@;
static const @int@ members[@nmembers@] = @members@;
"""

LEAF_LAW = """\
    return node;"""

LEAF_LIST = """\
    if (node >= @nlaws@) {
        real least;
        return scan(theta, lists[node - @nlaws@], lists[node - @nlaws@ + 1], &least);
    }
    return node;"""

SEQUENTIAL = """\
static int find_law(const real theta[NT], int *outside)
{
    real least;
    const int k = scan(theta, 0, @nregions@, &least);
    *outside = *outside || !(least <= TOLERANCE);
    return k;
}
"""


def real(value: float, scalar: str) -> str:
    """C literal that reads back as exactly the same number."""
    if scalar == "double":
        return repr(float(value))
    text = f"{float(np.float32(value)):.9g}"
    return text + ("f" if "." in text or "e" in text else ".0f")


def table(values: Any, scalar: str) -> str:
    """Nested C initialiser; a single zero for an empty table."""
    array = np.asarray(values)
    if array.size == 0:
        return "{0}" if array.ndim == 1 else "{{0}}"
    if array.ndim > 1:
        return "{\n" + ",\n".join(table(part, scalar) for part in array) + "}"
    if scalar in ("double", "float"):
        return "{" + ", ".join(real(v, scalar) for v in array) + "}"
    lines = [", ".join(str(int(v)) for v in array[i : i + 20]) for i in range(0, len(array), 20)]
    return "{" + ",\n".join(lines) + "}"


def as_name(name: Any) -> str:
    """Name that is a C identifier."""
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise InputError("name", repr(name), "a C identifier")
    return name


def as_scalar(scalar: Any) -> str:
    """Type of the numbers in C."""
    if scalar not in LARGEST:
        raise InputError("scalar", repr(scalar), "'double' or 'float'")
    return str(scalar)


def fill(template: str, fields: dict[str, Any]) -> str:
    """Template with its @fields@ filled in."""
    return re.sub(r"@(\w+)@", lambda match: str(fields[match[1]]), template)


def table_bytes(source: str, scalar: str) -> int:
    """Bytes of the constant tables in C source."""
    tables = re.findall(r"^static const (\w+) [^=]*= ([^;]*);", source, re.MULTILINE)
    return sum(SIZES[scalar if kind == "real" else kind] * (values.count(",") + 1) for kind, values in tables)


def written(folder: Path, name: str, header: str, source: str) -> tuple[Path, Path]:
    """Files `name`.h and `name`.c of a folder, which is created when missing."""
    files = (folder / f"{name}.h", folder / f"{name}.c")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for file, text in zip(files, (header, source)):
            file.write_text(text)
    except OSError as error:
        raise InputError("folder", f"{str(folder)!r} ({error.strerror})", "a folder that can be written to") from error
    return files
