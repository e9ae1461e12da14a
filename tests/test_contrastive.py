"""InfoNCE against its closed form, hard negatives, and pairs of the same place."""

import math

import pytest
import torch
from torch.nn import functional

from fusion.errors import SkyfixError
from learned.contrastive import Projection, info_nce, negatives

TAU = 0.07


def unit_vectors(count: int, size: int, seed: int) -> torch.Tensor:
    return functional.normalize(torch.randn(count, size, generator=torch.Generator().manual_seed(seed)), dim=1)


@pytest.mark.parametrize(("hard", "counted"), [(None, 5), (3, 3), (1, 1), (50, 5)])
def test_orthogonal_pairs_have_a_closed_form(hard: int | None, counted: int) -> None:
    """The positive has cosine 1, each of the negatives 0."""
    eye = torch.eye(6)
    expected = math.log1p(counted * math.exp(-1 / 0.5))
    assert float(info_nce(eye, eye, 0.5, hard)) == pytest.approx(expected, rel=1e-5)


def test_with_all_negatives_it_is_the_mean_of_two_cross_entropies() -> None:
    scans, maps = unit_vectors(7, 5, 0), unit_vectors(7, 5, 1)
    logits, own = scans @ maps.T / TAU, torch.arange(7)
    expected = 0.5 * (functional.cross_entropy(logits, own) + functional.cross_entropy(logits.T, own))
    torch.testing.assert_close(info_nce(scans, maps, TAU), expected)
    torch.testing.assert_close(info_nce(maps, scans, TAU), expected)  # symmetric


def test_hard_negatives_are_the_most_similar() -> None:
    scans, maps = unit_vectors(6, 4, 2), unit_vectors(6, 4, 3)
    logits = scans @ maps.T / TAU
    expected = []
    for table in (logits, logits.T):
        for row in range(6):
            others = sorted((float(table[row, col]) for col in range(6) if col != row), reverse=True)[:2]
            own = float(table[row, row])
            expected.append(math.log(sum(math.exp(v - own) for v in [own, *others])))
    assert float(info_nce(scans, maps, TAU, 2)) == pytest.approx(sum(expected) / 12, rel=1e-5)


def test_pairs_of_one_place_are_no_negatives() -> None:
    places = torch.tensor([[0.0, 0.0], [19.9, 0.0], [0.0, 20.1], [math.nan, math.nan]], dtype=torch.float64)
    expected = ~torch.eye(4, dtype=torch.bool)
    expected[0, 1] = expected[1, 0] = False
    assert torch.equal(negatives(4, places, 20.0), expected)
    scans, maps = unit_vectors(4, 4, 4), unit_vectors(4, 4, 5)
    masked = info_nce(scans, maps, TAU, None, places, 20.0)
    logits = (scans @ maps.T / TAU).masked_fill(~(expected | torch.eye(4, dtype=torch.bool)), -math.inf)
    own = torch.arange(4)
    by_hand = 0.5 * (functional.cross_entropy(logits, own) + functional.cross_entropy(logits.T, own))
    torch.testing.assert_close(masked, by_hand)
    assert float(info_nce(scans, maps, TAU)) > float(masked)


@pytest.mark.parametrize("places", [None, torch.zeros(1, 2)])
def test_a_single_pair_teaches_nothing_and_breaks_nothing(places: torch.Tensor | None) -> None:
    scans = unit_vectors(1, 4, 6).requires_grad_()
    loss = info_nce(scans, unit_vectors(1, 4, 7), TAU, 16, places)
    loss.backward()
    assert float(loss.detach()) == 0.0
    assert scans.grad is not None
    assert float(scans.grad.abs().max()) == 0.0


def test_anchors_without_any_negative_give_no_nan() -> None:
    scans, maps = unit_vectors(3, 4, 8).requires_grad_(), unit_vectors(3, 4, 9)
    loss = info_nce(scans, maps, TAU, 2, torch.zeros(3, 2))
    loss.backward()
    assert float(loss.detach()) == 0.0
    assert scans.grad is not None
    assert torch.isfinite(scans.grad).all()


def test_wrong_shapes_are_one_line() -> None:
    with pytest.raises(SkyfixError, match=r"embeddings: expected two of \(B, D\), got \(3, 4\) and \(2, 4\)"):
        info_nce(torch.ones(3, 4), torch.ones(2, 4))
    with pytest.raises(SkyfixError, match=r"positions: expected \(3, 2\), got \(2, 2\)"):
        info_nce(torch.ones(3, 4), torch.ones(3, 4), positions_m=torch.ones(2, 2))


def test_projections_are_unit_vectors() -> None:
    torch.manual_seed(0)
    vectors = Projection(16, 8)(torch.randn(5, 16) * 100)
    torch.testing.assert_close(vectors.norm(dim=1), torch.ones(5))
