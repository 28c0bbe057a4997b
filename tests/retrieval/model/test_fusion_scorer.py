"""Scoring stored partial activations in numpy: exact numbers, ties, and refused values."""

import numpy as np
import pytest

from retrieval.model.fusion_scorer import CELL_BLOCK, FusionScorer, StoredPartials, as_float32, to_stored


def random_scorer(hidden, seed=0):
    rng = np.random.default_rng(seed)
    second, bias, out, out_bias = (
        rng.normal(size=shape).astype(np.float32) for shape in ((hidden,) * 2, hidden, hidden, 1)
    )
    return FusionScorer(second, bias, out, out_bias)


def by_hand(scorer, touch, photo):
    """One pair, in plain loops over units."""
    first = [max(float(t) + float(p), 0.0) for t, p in zip(touch, photo, strict=True)]
    second = [
        max(sum(w * x for w, x in zip(row, first, strict=True)) + b, 0.0)
        for row, b in zip(scorer.second, scorer.second_bias, strict=True)
    ]
    return sum(w * x for w, x in zip(scorer.out, second, strict=True)) + scorer.out_bias[0]


def test_every_finite_float16_becomes_the_float32_of_the_same_value():
    every = np.arange(65536, dtype=np.uint16).view(np.float16)
    finite = every[np.isfinite(every)]
    assert np.array_equal(as_float32(finite), finite.astype(np.float32))
    assert np.array_equal(np.signbit(as_float32(finite)), np.signbit(finite))  # includes -0
    subnormal = np.float16(2.0**-24)
    assert as_float32(np.array([subnormal]))[0] == 2.0**-24


@pytest.mark.parametrize("bad", [np.nan, -np.inf])
def test_a_float16_that_is_not_finite_stays_so_although_shifted_bits_would_make_it_finite(bad):
    values = np.array([1.0, bad], dtype=np.float16)
    naive = (values.view(np.int16).astype(np.int32) << 13 & 0x0FFFE000).view(np.float32) * np.float32(2.0**112)
    assert np.isfinite(naive).all()
    np.testing.assert_array_equal(as_float32(values), values.astype(np.float32))


def cell_score(touch_cells, photo_cells):
    """The sum of the largest products, in plain loops."""
    return sum(
        max(sum(float(t) * float(p) for t, p in zip(mine, other, strict=True)) for other in photo_cells)
        for mine in touch_cells
    )


def test_cells_add_for_each_touch_cell_its_largest_product_with_a_photo_cell():
    scorer, rng = random_scorer(4), np.random.default_rng(3)
    scorer = FusionScorer(scorer.second, scorer.second_bias, scorer.out, scorer.out_bias, cosine_dim=2, cell_dim=3)
    touches = rng.normal(size=(2, 4 + 2 + 5 * 3)).astype(np.float32)
    photos = rng.normal(size=(CELL_BLOCK + 2, 4 + 2 + 7 * 3)).astype(np.float32)
    expected = [
        sum(
            by_hand(scorer, touch[:4], photo[:4])
            + float(touch[4:6] @ photo[4:6])
            + cell_score(touch[6:].reshape(5, 3), photo[6:].reshape(7, 3))
            for touch in touches
        )
        for photo in photos
    ]
    np.testing.assert_allclose(scorer.logits(touches, photos), expected, rtol=1e-5, atol=1e-4)


def unit_partials(rows, pooled, cells, dim):
    rng = np.random.default_rng(5)
    vectors = rng.normal(size=(rows, cells, dim))
    vectors /= np.linalg.norm(vectors, axis=2, keepdims=True)
    return np.concatenate([rng.normal(size=(rows, pooled)), vectors.reshape(rows, -1)], axis=1).astype(np.float32)


def test_stored_cells_are_wrong_by_at_most_half_a_step_of_1_127():
    partials = unit_partials(9, 6, 4, 8)
    stored = StoredPartials(to_stored(partials, 6))
    assert stored.shape == partials.shape
    assert len(stored) == 9
    assert np.abs(stored[:][:, 6:] - partials[:, 6:]).max() <= 0.5 / 127 + 1e-6  # float32 rounding of the product
    np.testing.assert_array_equal(stored[:][:, :6], partials[:, :6].astype(np.float16).astype(np.float32))
    np.testing.assert_array_equal(stored[np.array([7, 2])], stored[:][[7, 2]])
