"""Settings changed by dotted keys: exactly what is named changes, and whatever is wrong is one clear line."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from fusion.errors import SkyfixError
from fusion.particles.kld_sampling import KldSampling
from sequences.dotted_keys import changed, dotted, split_override
from sequences.track_settings import SETTABLE, TrackSettings

DEFAULTS = TrackSettings("wheels")
NAMES = SETTABLE


def leaves(settings: TrackSettings) -> dict[str, Any]:
    return dotted(asdict(settings))


LEAVES = leaves(DEFAULTS)
WRITABLE = [key for key in LEAVES if key.partition(".")[0] in NAMES]


@pytest.mark.parametrize("key", WRITABLE)
def test_every_setting_can_be_written_as_it_is(key: str) -> None:
    written = yaml.safe_dump(LEAVES[key]).removesuffix("...\n").strip()
    assert leaves(changed(DEFAULTS, [f"{key}={written}"], NAMES)) == LEAVES


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("particles", 500),
        ("filter.resampler", "residual"),
        ("filter.guided_share", 0.25),
        ("search.patience", 7),
        ("smoother.odometry_kernel", "none"),
        ("noise.lateral_m_per_sqrt_m", 0.5),
    ],
)
def test_only_what_is_named_changes(key: str, value: object) -> None:
    assert leaves(changed(DEFAULTS, [f"{key}={value}"], NAMES)) == {**LEAVES, key: value}


def test_what_was_none_begins_with_its_defaults_and_goes_on_from_there() -> None:
    one = changed(DEFAULTS, ["filter.adaptive.most=50000"], NAMES)
    assert one.filter.adaptive == KldSampling(most=50_000)
    two = changed(one, ["filter.adaptive.error=0.05"], NAMES)
    assert two.filter.adaptive == KldSampling(most=50_000, error=0.05)
    assert changed(two, ["filter.adaptive={least: 10}"], NAMES).filter.adaptive == KldSampling(least=10)
    assert changed(two, ["filter.adaptive=null"], NAMES).filter.adaptive is None
    assert DEFAULTS.filter.adaptive is None


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("filter.resampler=wheel", "resampler: expected one of systematic.*got 'wheel'"),
        ("filter.threads=two", "valid integer"),
        ("filter.thread=2", "expected one of resampler, .*got 'thread'"),
        ("filter.threads.count=2", "expected a value for threads, which holds no settings, got count"),
        ("filter.adaptive.least=0", "1 <= least <= most, got 0"),
        ("search.max_half_extent_m=5", "expected at least min_half_extent_m, 12, got 5"),
        ("search.sigmas=.nan", "sigmas: expected a finite number, got nan"),
        ("noise=3", "expected one of particles=VALUE, .*, search.KEY=VALUE, filter.KEY=VALUE"),
        ("seed=3", "expected one of particles=VALUE"),
        ("particles.x=3", "expected a value for particles, which holds no settings, got x"),
        ("particles=0", "particles: expected more than 0, got 0"),
        ("smoother.odometry_kernel=dcs", "odometry_kernel: expected huber or none"),
        ("smoother.drift={}", "smoother drift: expected none, it is found from the drive"),
        ("filter.threads", "expected KEY.KEY=VALUE"),
        ("filter..threads=2", "expected KEY.KEY=VALUE"),
        ("filter.threads=[", "expected a YAML value"),
    ],
)
def test_what_is_wrong_is_said_with_the_override(override: str, expected: str) -> None:
    with pytest.raises(SkyfixError, match=expected) as raised:
        changed(DEFAULTS, [override], NAMES)
    assert str(raised.value).startswith("--set")
    assert "\n" not in str(raised.value)


KEYS = st.text(st.characters(codec="ascii", categories=["Ll"]), min_size=1, max_size=4)


@given(st.dictionaries(KEYS, st.one_of(st.integers(), st.booleans(), st.dictionaries(KEYS, st.integers(), min_size=1))))
def test_dotted_keys_read_back_as_the_same_path_and_value(content: dict[str, Any]) -> None:
    for key, value in dotted(content).items():
        path, read = split_override(f"{key}={yaml.safe_dump(value).removesuffix('...' + chr(10))}")
        found: Any = content
        for part in path:
            found = found[part]
        assert read == found == value
