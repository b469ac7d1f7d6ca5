"""C99 source for a learned policy, without allocation or libraries."""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial, log
from pathlib import Path
from typing import Any

import numpy as np

from ccdtools.arrays import Array
from ccdtools.controllers.filter_code import FILTER, FILTER_HEADER, filter_fields
from learning.networks import Layers
from mpc.explicit.codegen.c_source import HEADER, LARGEST, as_name, as_scalar, fill, real, table, table_bytes, written

# Degree of the series of exp within half a binary digit, and where tanh is 1: both to the digits of the scalar.
SERIES = {"double": (11, 20.0), "float": (6, 9.5)}
FARTHEST = 1e30  # Normalised states beyond this are cut off there: products with weights stay finite.

SOURCE = """\
/* @what@: @summary@. Generated; do not edit. */
#include "@name@.h"

#include <float.h>

#define NT @NAME@_NT
#define NU @NAME@_NU

typedef @name@_real real;

static const real centre[NT] = @centre@;
static const real inverse[NT] = @inverse@; /* of the half-widths of the states */
@tables@
static const real middle[NU] = @middle@;
static const real half[NU] = @half@;
static const real nearest[NU] = @nearest@; /* to zero, of all inputs */
static const real power[@powers@] = @power@; /* of 2 */

/* 1 - 2/(exp(2|v|) + 1) with the sign of v; exp by a power of 2 and a series */
static real hyperbolic_tangent(real v)
{
    const real size = v < 0 ? -v : v;
    real rest, e;
    int k;
    if (!(size < @one@)) {
        return v < 0 ? -1 : 1;
    }
    k = (int)(size * @per_digit@ + @rounded@);
    rest = 2 * size - (real)k * @digit@;
    e = @series@;
    e = 1 - 2 / (power[k] * e + 1);
    return v < 0 ? -e : e;
}

int @name@_law(const real theta[NT], real u[NU])
{
    real layer0[NT];@layers@
    int i, j;
    for (j = 0; j < NT; j++) {
        if (!(theta[j] >= -@largest@ && theta[j] <= @largest@)) {
            for (i = 0; i < NU; i++) {
                u[i] = nearest[i];
            }
            return 2;
        }
        layer0[j] = (theta[j] - centre[j]) * inverse[j];
        layer0[j] = layer0[j] > @far@ ? @far@ : layer0[j] < -@far@ ? -@far@ : layer0[j];
    }
@body@
    for (i = 0; i < NU; i++) {
        const real latent = layer@last@[i];
        u[i] = middle[i] + half[i] * (latent > 1 ? 1 : latent < -1 ? -1 : latent);
    }
    return 0;
}
"""

TABLES = """\
static const real weight@k@[@n@][@m@] = @weight@;
static const real bias@k@[@m@] = @bias@;
"""

LAYER = """\
    for (i = 0; i < @m@; i++) {
        layer@k@[i] = bias@k@[i];
    }
    for (j = 0; j < @n@; j++) {
        for (i = 0; i < @m@; i++) {
            layer@k@[i] += weight@k@[j][i] * layer@before@[j];
        }
    }
"""

TANH = """\
    for (i = 0; i < @m@; i++) {
        layer@k@[i] = hyperbolic_tangent(layer@k@[i]);
    }
"""

SKIP = """\
    for (j = 0; j < NT; j++) {
        for (i = 0; i < NU; i++) {
            layer@last@[i] += skip[j][i] * layer0[j];
        }
    }
"""

MEMORY_HEADER = """
#define @NAME@_NY @ny@ /* outputs */

/* The last @length@ outputs, the latest first, then as many inputs: theta of the law. One for each loop. */
typedef struct {
    @name@_real theta[@NAME@_NT];
} @name@_state;

/* Outputs and inputs before the first sample are zero. */
void @name@_reset(@name@_state *state);

/* Write the input that belongs to an output into u. The input of the sample before, as it was applied, may be u itself.
   Returns what the law returns. */
int @name@_step(@name@_state *state, const @name@_real y[@NAME@_NY], const @name@_real u_prev[@NAME@_NU],
                @name@_real u[@NAME@_NU]);

#endif
"""

MEMORY = """
#define NY @NAME@_NY
#define OUTPUTS @outputs@ /* entries of theta before the inputs */

void @name@_reset(@name@_state *state)
{
    int j;
    for (j = 0; j < NT; j++) {
        state->theta[j] = 0;
    }
}

int @name@_step(@name@_state *state, const real y[NY], const real u_prev[NU], real u[NU])
{
    real *theta = state->theta;
    int j;
    for (j = NT - 1; j >= OUTPUTS; j--) {
        theta[j] = j < OUTPUTS + NU ? u_prev[j - OUTPUTS] : theta[j - NU];
    }
    for (; j >= 0; j--) {
        theta[j] = j < NY ? y[j] : theta[j - NY];
    }
    return @name@_law(theta, u);
}
"""


@dataclass(frozen=True)
class PolicyCode:
    """Report of the written code and its costs.

    Attributes
    ----------
    files : (Path, Path)
        Header and source.
    scalar : str
        "double" or "float".
    flash_bytes : int
        Size of the constant tables [B].
    operations, tangents : int
        Multiply-adds and hyperbolic tangents a call.
    """

    files: tuple[Path, Path]
    scalar: str
    flash_bytes: int
    operations: int
    tangents: int

    def __str__(self) -> str:
        return (
            f"{self.scalar}: {self.flash_bytes} bytes of tables, {self.operations} multiply-adds and "
            f"{self.tangents} hyperbolic tangents a call"
        )


def write_c(
    layers: Layers, centre: Array, width: Array, action_range: tuple[Array, Array], folder: Path, *, name: str,
    scalar: str, length: int = 0, estimator: Any = None,
) -> PolicyCode:  # fmt: skip
    """Report of `name`.h and `name`.c, written for layers in normalised states.

    States are normalised by `centre` and half-`width` (nx,); `action_range` is middle and half-width (nu,) of the
    inputs. With a `length` the states are histories of so many outputs and inputs, and the code remembers them; with an
    `estimator` they are the estimate of a filter, which the code has within it.
    """
    as_name(name)
    as_scalar(scalar)
    middle, half = action_range
    tables, body, widths = _network(layers, scalar)
    degree, one = SERIES[scalar]
    powers = 2.0 ** np.arange(int(2 * one / log(2)) + 2)
    *hidden, _ = widths
    fields = {
        "what": "Learned policy", "name": name, "NAME": name.upper(), "scalar": scalar, "nt": len(centre),
        "nu": len(middle), "summary": f"{len(hidden)} hidden layers of {', '.join(map(str, hidden))}", "outside": "",
        "centre": table(centre, scalar), "inverse": table(1 / width, scalar), "tables": tables,
        "middle": table(middle, scalar), "half": table(half, scalar),
        "nearest": table(np.clip(0.0, middle - half, middle + half), scalar), "powers": len(powers),
        "power": table(powers, scalar), "one": real(one, scalar), "per_digit": real(2 / log(2), scalar),
        "rounded": real(0.5, scalar), "digit": real(log(2), scalar), "series": _series(degree, scalar),
        "layers": "".join(f" real layer{k}[{m}];" for k, m in enumerate(widths, start=1)), "largest": LARGEST[scalar],
        "far": real(FARTHEST, scalar), "body": body, "last": len(widths),
    }  # fmt: skip
    source, header = SOURCE, HEADER
    if length:
        outputs = len(centre) - length * len(middle)
        fields |= {"length": length, "outputs": outputs, "ny": outputs // length}
        source, header = SOURCE + MEMORY, HEADER.removesuffix("\n#endif\n") + MEMORY_HEADER
    elif estimator is not None:
        fields |= filter_fields(estimator, scalar)
        source, header = SOURCE + FILTER, HEADER.removesuffix("\n#endif\n") + FILTER_HEADER
    source = fill(source, fields)
    files = written(folder, name, fill(header, fields), source)
    weights = [W for W, _ in layers.maps] + ([] if layers.skip is None else [layers.skip[0]])
    operations = len(centre) + sum(map(np.size, weights)) + len(middle)
    return PolicyCode(files, scalar, table_bytes(source, scalar), operations, sum(hidden))


def _network(layers: Layers, scalar: str) -> tuple[str, str, list[int]]:
    """C text of the tables and of the layers, and the widths of the layers."""
    maps = list(layers.maps)
    if layers.skip is not None:  # its bias belongs to the output layer
        maps[-1] = (maps[-1][0], maps[-1][1] + layers.skip[1])
    tables = body = ""
    for k, (W, b) in enumerate(maps, start=1):
        fields = {"k": k, "before": k - 1, "n": W.shape[0], "m": W.shape[1]}
        tables += fill(TABLES, fields | {"weight": table(W, scalar), "bias": table(b, scalar)})
        body += fill(LAYER + (TANH if k < len(maps) else ""), fields)
    if layers.skip is not None:
        tables += f"static const real skip[NT][NU] = {table(layers.skip[0], scalar)};\n"
        body += fill(SKIP, {"last": len(maps)})
    return tables.rstrip(), body.rstrip(), [len(b) for _, b in maps]


def _series(degree: int, scalar: str) -> str:
    """C text of the series of exp in `rest`, by Horner's rule."""
    text = real(1 / factorial(degree), scalar)
    for k in reversed(range(degree)):
        text = f"{real(1 / factorial(k), scalar)} + rest * ({text})"
    return text
