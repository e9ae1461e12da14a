"""States of filters as trees, for a file: dataclasses within dataclasses, and tuples of them.

Numbers, strings and arrays stay as they are; a dataclass inside a state becomes a dictionary with its type's name, and
only types known here are made again.
"""

from dataclasses import fields, is_dataclass
from typing import Any

from fusion.errors import SkyfixError
from fusion.fixed_lag import LagCounts, LagState
from fusion.gaussian_likelihood import GaussianLikelihood
from fusion.gaussian_mixture import GaussianMixture
from fusion.graph.lag_window import LagWindow
from fusion.graph.patch import LikelihoodPatch
from fusion.graph_filter import GraphFilterState
from fusion.grid import MapGrid
from fusion.hypotheses import HypothesisState
from fusion.likelihood import OutlierMixture
from fusion.particles.filter_state import ParticleFilterState
from fusion.tracking.archive import Tree

_TYPE, _TUPLE = "$type", "$tuple"
_TYPES: dict[str, type] = {
    kind.__name__: kind
    for kind in (
        GaussianLikelihood,
        GaussianMixture,
        GraphFilterState,
        HypothesisState,
        LagCounts,
        LagState,
        LagWindow,
        LikelihoodPatch,
        MapGrid,
        OutlierMixture,
        ParticleFilterState,
    )
}


def state_tree(state: Any) -> dict[str, Tree]:
    """The fields of a state, a dataclass.

    Raises
    ------
    SkyfixError
        When a dataclass within it is of a type that skyfix does not know.
    """
    return {entry.name: _tree(getattr(state, entry.name)) for entry in fields(state)}


def state_values(tree: dict[str, Any]) -> dict[str, Any]:
    """The values of the fields that were written."""
    return {name: _value(value) for name, value in tree.items()}


def _tree(value: Any) -> Tree:
    if isinstance(value, tuple):
        return {_TUPLE: [_tree(one) for one in value]}
    if is_dataclass(value):
        name = type(value).__name__
        if name not in _TYPES:
            raise SkyfixError(f"state: expected one of {', '.join(_TYPES)} to write, got {name}")
        return {_TYPE: name, **state_tree(value)}
    tree: Tree = value
    return tree


def _value(tree: Any) -> Any:
    if not isinstance(tree, dict):
        return tree
    if _TUPLE in tree:
        return tuple(_value(one) for one in tree[_TUPLE])
    if _TYPE in tree:
        return _TYPES[tree[_TYPE]](**{name: _value(value) for name, value in tree.items() if name != _TYPE})
    return tree
