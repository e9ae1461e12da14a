"""Likelihoods as trees of arrays and numbers, to be compared and to be written to a file."""

from dataclasses import asdict
from typing import Any

import numpy as np

from fusion.emulation.emulated_likelihood import EmulatedLikelihood
from fusion.errors import SkyfixError
from fusion.gaussian_likelihood import GaussianLikelihood
from fusion.grid import MapGrid
from fusion.lazy_orientation import LazyOrientation
from fusion.likelihood import LikelihoodVolume, OutlierMixture, PoseLikelihood
from fusion.location_orientation import LocationOrientationMaps
from fusion.tracking.archive import Tree, plain
from fusion.two_level import TwoLevelLikelihood

_FIELDS: dict[type, tuple[str, ...]] = {
    GaussianLikelihood: ("mean", "covariance", "floor"),
    LikelihoodVolume: ("log_prob", "floor"),
    LocationOrientationMaps: ("location", "orientation", "confidence", "floor"),
    LazyOrientation: ("location", "features", "weights", "bias", "floor", "temperature"),
    TwoLevelLikelihood: ("coarse", "cut", "fine", "floor"),
    EmulatedLikelihood: ("answer", "half_box", "weights", "centres", "sigmas", "halves", "temperature", "floor"),
}
_WITHOUT_GRID = (EmulatedLikelihood,)  # its grid follows from the rest


def likelihood_tree(likelihood: PoseLikelihood) -> dict[str, Tree]:
    """The likelihood's fields.

    Raises
    ------
    SkyfixError
        When it is of a type that skyfix does not know.
    """
    if isinstance(likelihood, OutlierMixture):
        inner = likelihood_tree(likelihood.likelihood)
        return {"type": "OutlierMixture", "likelihood": inner, "probability": likelihood.probability}
    names = _FIELDS.get(type(likelihood))
    if names is None:
        known = ", ".join(kind.__name__ for kind in [*_FIELDS, OutlierMixture])
        raise SkyfixError(f"likelihood: expected one of {known} to write, got {type(likelihood).__name__}")
    values: dict[str, Tree] = {name: getattr(likelihood, name) for name in names}
    grid: dict[str, Tree] = {} if type(likelihood) in _WITHOUT_GRID else {"grid": asdict(likelihood.grid)}
    return {"type": type(likelihood).__name__, **grid, **values}


def likelihood_from_tree(tree: Any) -> PoseLikelihood:
    """The likelihood that was written."""
    fields = dict(tree)
    name = fields.pop("type")
    if name == "OutlierMixture":
        return OutlierMixture(likelihood_from_tree(fields["likelihood"]), fields["probability"])
    kind = {known.__name__: known for known in _FIELDS}[name]
    if "grid" in fields:
        fields["grid"] = MapGrid(**fields["grid"])
    if kind is LazyOrientation:  # the temperature is no argument of it
        temperature = fields.pop("temperature")
        return LazyOrientation(**fields).tempered(temperature)
    likelihood: PoseLikelihood = kind(**fields)
    return likelihood


def is_same_likelihood(a: PoseLikelihood, b: PoseLikelihood) -> bool:
    """Whether both say the same; of types that skyfix does not know, whether they are one object."""
    if a is b:
        return True
    try:
        return _is_same(likelihood_tree(a), likelihood_tree(b))
    except SkyfixError:
        return False


def _is_same(a: Tree, b: Tree) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return np.array_equal(a, b)
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(_is_same(value, b[key]) for key, value in a.items())
    if isinstance(a, np.ndarray | dict) or isinstance(b, np.ndarray | dict):
        return False
    a, b = plain(a), plain(b)
    return type(a) is type(b) and bool(a == b)
