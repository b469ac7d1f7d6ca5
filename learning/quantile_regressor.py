"""Quantile regression in the manner of scikit-learn's estimators, without scikit-learn."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ccdtools_ground.door import shown
from learning.checks import as_samples
from learning.exceptions import InputError
from learning.quantile import QuantileConfig, fit_quantiles, pinball

Array = NDArray[np.float64]


@dataclass(eq=False)
class QuantileRegressor:
    """Conditional quantiles that cannot cross, calibrated on the last part of the samples.

    The arguments are those of `QuantileConfig`, kept as given until `fit`; `clone`, pipelines and cross-validation of
    scikit-learn take it as one of theirs. Each outer level is held on its side with the rank of finitely many samples.

    Attributes
    ----------
    random_state : int or numpy.random.Generator
        Of the weights and batches; the same integer gives the same fit.
    n_features_in_ : int
        After `fit`.
    network_ : QuantileNetwork
        After `fit`: to save, or to draw from.
    """

    levels: tuple[float, ...] = QuantileConfig.levels
    hidden: tuple[int, ...] = QuantileConfig.hidden
    steps: int = QuantileConfig.steps
    batch: int = QuantileConfig.batch
    learning_rate: float = QuantileConfig.learning_rate
    weight_decay: float = QuantileConfig.weight_decay
    calibration: float = QuantileConfig.calibration
    random_state: int | np.random.Generator = 0

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Arguments by name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def set_params(self, **params: Any) -> QuantileRegressor:
        """Estimator with other arguments: this one, changed."""
        for name, value in params.items():
            if name not in self.get_params():
                raise InputError(name, "no argument of QuantileRegressor", f"one of {', '.join(self.get_params())}")
            setattr(self, name, value)
        return self

    def fit(self, X: ArrayLike, y: ArrayLike) -> QuantileRegressor:
        """Estimator after a fit to inputs (n, d) and targets (n,) or (n, m), in time order.

        Raises
        ------
        InputError
            As `fit_quantiles`, and as `QuantileConfig`; or if X is sparse or y is None.
        """
        inputs, targets = _dense("X", X), _dense("y", y)
        params = self.get_params()
        state = params.pop("random_state")
        try:
            rng = np.random.default_rng(state)
        except (TypeError, ValueError):
            raise InputError("random_state", shown(state), "a whole number or a numpy.random.Generator") from None
        self.network_ = fit_quantiles(inputs, targets, rng=rng, config=QuantileConfig(**params))
        self.n_features_in_ = len(self.network_.input_offset)
        self._vector = targets.ndim == 1
        return self

    def predict(self, X: ArrayLike) -> Array:
        """Quantiles (n, levels), or (n, levels, m) where the targets of the fit were (n, m)."""
        if not hasattr(self, "network_"):
            raise _not_fitted()
        quantiles = self.network_.predict(_dense("X", X))
        return quantiles[..., 0] if self._vector else quantiles

    def score(self, X: ArrayLike, y: ArrayLike) -> float:
        """Mean pinball loss, negative: more is better."""
        x, targets = as_samples(_dense("X", X), _dense("y", y), least=1)
        quantiles = self.predict(x).reshape(len(x), len(self.network_.levels), -1)
        if targets.shape[1] != quantiles.shape[2]:
            raise InputError("y", f"{targets.shape[1]} targets", f"{quantiles.shape[2]}, as in the fit")
        return -float(np.mean(pinball(targets, quantiles, self.network_.levels)))

    def __sklearn_tags__(self) -> Any:
        """What scikit-learn asks of its estimators."""
        from sklearn.utils import InputTags, RegressorTags, Tags, TargetTags

        return Tags(
            estimator_type="regressor", target_tags=TargetTags(required=True, multi_output=True),
            regressor_tags=RegressorTags(), input_tags=InputTags(),
        )  # fmt: skip


def _dense(name: str, values: Any) -> Any:
    """Array of what numpy takes for one, in the words of scikit-learn where it does not."""
    if values is None:
        cure = "Fit requires y to be passed, but the target y is None." if name == "y" else ""
        raise InputError(name, "None", "an array", cure)
    if hasattr(values, "toarray"):
        raise InputError(name, "a sparse array", "a dense one", "Sparse data is not supported: pass X.toarray().")
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise InputError(name, f"a ragged sequence ({error})", "an array") from None
    if np.iscomplexobj(array):
        raise InputError(name, "complex numbers", "real ones", "Complex data not supported.")
    if array.dtype == object:
        try:
            array = array.astype(float)
        except (TypeError, ValueError) as error:
            raise InputError(name, f"objects ({error})", "numbers") from None
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise InputError(name, "NaN or infinity", "finite numbers")
    if name == "X" and (array.ndim != 2 or not array.shape[1]):
        few = f"0 feature(s) (shape={array.shape}) while a minimum of 1 is required."
        cure = few if array.ndim == 2 else "Reshape your data: X.reshape(-1, d)."
        raise InputError(name, f"shape {array.shape}", "(n, d)", cure)
    return array


def _not_fitted() -> InputError:
    """Error before `fit`, which scikit-learn knows as its own where it is installed."""
    said = ("self", "a QuantileRegressor without a fit", "one after `fit`")
    try:
        from sklearn.exceptions import NotFittedError
    except ImportError:
        return InputError(*said)
    again = {"__reduce__": lambda _: (_not_fitted, ())}  # pickled as the call that makes it
    kind: type[InputError] = type("NotFittedInputError", (InputError, NotFittedError), again)
    return kind(*said)
