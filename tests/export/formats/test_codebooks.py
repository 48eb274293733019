"""Codebooks of values and of vectors."""

import numpy as np

from thermosplat.export.formats.codebooks import value_codebook, vector_codebook


def test_few_values_are_kept_exactly() -> None:
    """A codebook with an entry for each value has no error."""
    values = np.array([[1.0, 5.0], [-2.0, 5.0]], np.float32)
    book, labels = value_codebook(values, 256)
    assert len(book) == 256
    assert (np.diff(book) >= 0).all()
    np.testing.assert_array_equal(book[labels], values)


def test_values_are_coded_better_than_by_even_steps() -> None:
    """Lloyd's entries are where the values are: half the error of even steps, and no value has a nearer entry."""
    values = np.random.default_rng(0).normal(size=5000).astype(np.float32) ** 3
    book, labels = value_codebook(values, 64)
    np.testing.assert_allclose(np.abs(values - book[labels]), np.abs(values[:, None] - book).min(axis=1), atol=1e-6)
    even = np.linspace(values.min(), values.max(), 64)
    worse = np.abs(values[:, None] - even).min(axis=1)
    assert np.square(values - book[labels]).mean() < 0.5 * np.square(worse).mean()


def test_clusters_of_vectors_are_found() -> None:
    """Vectors around a few centres are coded by entries near them, and never by more entries than asked for."""
    rng = np.random.default_rng(0)
    centres = rng.normal(size=(20, 6)).astype(np.float32)
    vectors = np.repeat(centres, 100, axis=0) + 0.01 * rng.normal(size=(2000, 6)).astype(np.float32)
    book, labels = vector_codebook(vectors, 200)
    assert len(book) <= 200
    assert np.abs(book[labels] - vectors).max() < 0.3
    assert np.square(book[labels] - vectors).mean() < 1e-3


def test_fewer_vectors_than_entries_are_kept() -> None:
    """Each vector is an entry then."""
    vectors = np.random.default_rng(0).normal(size=(10, 3)).astype(np.float32)
    book, labels = vector_codebook(vectors, 1024)
    np.testing.assert_array_equal(book[labels], vectors)
