"""A viewer shows classes in their colours, components of features, and where these are like a vector."""

from pathlib import Path

import numpy as np
import pytest

from labelled_toy import LABELS, labelled_capture
from stacked_toy import CHANNELS, stacked
from thermosplat.class_colors import numbers_of
from thermosplat.errors import UserError
from thermosplat.viewer.layers import Layer, LayerRenderer, available_layers
from thermosplat.viewer.opening import open_scene
from toy_run import toy_run_config, toy_trainer


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three steps with labels and features."""
    path = tmp_path_factory.mktemp("runs") / "toy"
    spectra = {"labels": LABELS, "stack": {"source": "features", "channels": CHANNELS}}
    toy_trainer(path, toy_run_config(3, spectra=spectra, data="gone/toy"), stacked(labelled_capture())).train()
    return path


def test_labels_and_a_query_are_shown(run: Path, tmp_path: Path) -> None:
    """Every layer has the asked size; pixels of labels have colours of classes; the query is from 0 to 1."""
    np.save(tmp_path / "query.npy", np.ones((1, CHANNELS)))
    scene, _, _ = open_scene(str(run), device="cpu", query=str(tmp_path / "query.npy"))
    layers = available_layers(scene)
    start = scene.start()
    images = LayerRenderer(scene).render(layers, scene.view(start.viewmat, start.fov_y, 24, 18))
    assert all(image.size == (24, 18) for image in images.values())
    colors = images[Layer("image", "labels")].colors
    assert colors is not None
    assert set(np.unique(numbers_of(*np.moveaxis(colors.astype(int), -1, 0)))) <= {0, 1, 2}
    assert images[Layer("image", "stack")].colors is not None
    query = images[Layer("query", "stack")]
    assert query.field is not None
    assert query.range == (0.0, 1.0)
    assert np.ptp(query.field) > 0


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (np.ones(3), "stack is asked by 20 finite numbers"),
        (np.array(["a"]), "cannot be read"),
        (None, "cannot be read"),
    ],
)
def test_what_is_no_query_is_refused(run: Path, tmp_path: Path, content: np.ndarray | None, expected: str) -> None:
    """Another length, another kind and a missing file are sentences."""
    if content is not None:
        np.save(tmp_path / "query.npy", content)
    with pytest.raises(UserError, match=expected):
        open_scene(str(run), device="cpu", query=str(tmp_path / "query.npy"))
