"""Keys of nested settings as dotted paths: KEY.KEY=VALUE as `--set` takes it, and settings listed by such keys."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar, get_args, get_type_hints

import yaml
from pydantic import TypeAdapter, ValidationError

from fusion.errors import SkyfixError

Settings = TypeVar("Settings")


def split_override(override: str) -> tuple[list[str], Any]:
    """Keys and value of "KEY.KEY=VALUE", the value as in YAML; SkyfixError if it is not that."""
    path, separator, text = override.partition("=")
    keys = [key.strip() for key in path.split(".")]
    if not separator or not all(keys):
        raise SkyfixError(f"--set: expected KEY.KEY=VALUE, got {override!r}")
    try:
        return keys, yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise SkyfixError(f"--set {path}: expected a YAML value, got {text!r}") from error


def as_overrides(changes: Mapping[str, Any]) -> tuple[str, ...]:
    """ "KEY.KEY=VALUE" of dotted keys and values, such that `split_override` gives them back."""
    # In a list, because YAML ends a bare value with a line of dots.
    return tuple(
        f"{key}={yaml.safe_dump([value], default_flow_style=True, width=math.inf).strip()[1:-1]}"
        for key, value in changes.items()
    )


def dotted(content: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one mapping of dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in content.items():
        flat |= dotted(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return flat


def changed(settings: Settings, overrides: Iterable[str], names: Collection[str]) -> Settings:
    """Settings with some of their values replaced.

    Parameters
    ----------
    settings
        A frozen dataclass, which checks itself.
    overrides
        "KEY=VALUE" or "GROUP.KEY=VALUE" each. A KEY may itself hold settings: "GROUP.KEY.KEY=VALUE", where what was
        None so far begins with its defaults, or "GROUP.KEY={...}" for several at once, the others at their defaults.
    names
        Fields of the settings that may be changed, or whose fields may.

    Raises
    ------
    SkyfixError
        If a key is unknown, or a value has the wrong type or is out of range.
    """
    groups = {name for name in names if is_dataclass(getattr(settings, name))}
    for override in overrides:
        keys, value = split_override(override)
        shown = f"--set {override}"
        if keys[0] not in names or (keys[0] in groups and len(keys) == 1):
            expected = (f"{name}.KEY=VALUE" if name in groups else f"{name}=VALUE" for name in names)
            raise SkyfixError(f"{shown}: expected one of {', '.join(expected)}")
        try:
            settings = _replaced(settings, keys, value)
        except ValidationError as error:
            raise SkyfixError(f"{shown}: {error.errors()[0]['msg']}") from error
        except SkyfixError as error:
            raise SkyfixError(f"{shown}: {error}") from error
    return settings


def _replaced(settings: Any, keys: list[str], value: Any) -> Any:
    key, *inner = keys
    names = [entry.name for entry in fields(settings)]
    if key not in names:
        raise SkyfixError(f"expected one of {', '.join(names)}, got {key!r}")
    expected = get_type_hints(type(settings))[key]
    if not inner:
        return replace(settings, **{key: TypeAdapter(expected).validate_python(value)})
    kinds: list[Any] = [kind for kind in get_args(expected) if is_dataclass(kind)]
    group = getattr(settings, key)
    if group is None and kinds:
        group = kinds[0]()
    if not is_dataclass(group):
        raise SkyfixError(f"expected a value for {key}, which holds no settings, got {'.'.join(inner)}")
    return replace(settings, **{key: _replaced(group, inner, value)})
