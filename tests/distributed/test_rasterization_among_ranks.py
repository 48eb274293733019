"""Renders of Gaussians that are divided over ranks equal those of one process."""

from typing import Any

import pytest
import torch

import divided_renders as work
from ranks import Ranks
from thermosplat import UserError, rasterization

CASES = [
    ("plain", {"absgrad": True}, 2, False),
    ("plain", {"render_mode": "RGB+ED", "rasterize_mode": "antialiased", "eps2d": 0.1}, 3, False),
    ("plain", {"channel_chunk": 2, "absgrad": True}, 3, True),
    ("rgbt", {"absgrad": True}, 2, False),
    ("rgbt", {"rasterize_mode": "antialiased"}, 3, True),
]


@pytest.mark.rotating
@pytest.mark.parametrize(
    ("kind", "options", "count", "idle", "dtype", "spare"),
    [(*case, torch.float64, None) for case in CASES]
    + [(*case, torch.float32, None) for case in CASES if case[-1]]
    + [(*case, torch.float64, 1.1) for case in CASES if "channel_chunk" not in case[1]],
)
def test_images_and_gradients_equal_one_process(
    ranks: Ranks, kind: str, options: dict[str, Any], count: int, idle: bool, dtype: torch.dtype, spare: float | None
) -> None:
    """Also with a rank that has no camera, several cameras of a rank, absolute gradients and gradients of cameras.

    With a room for rows and pairs nothing is read back from the device, and nothing changes.
    """
    whole = work.undivided(kind, options, dtype)
    shares = ranks.run(work.divided, count, kind, options, idle, dtype, spare)
    assert not any(share["overflow"] or share["is_short"] for share in shares)
    tolerance = 1e-5 if dtype == torch.float32 else 1e-11
    for name, expected in whole["gradients"].items():
        places = "cameras" if name in work.CAMERA else "share"
        having = [share for share in shares if name in share["gradients"]]
        assert len(having) == (1 if idle and name in work.CAMERA else count), name
        for share in having:
            part = expected[share[places]]
            assert len(part) == 0 or part.abs().max() > 0, name
            found, atol = share["gradients"][name], tolerance * expected.abs().max()
            torch.testing.assert_close(found, part, rtol=tolerance, atol=atol, msg=name)
    for number, expected in enumerate(whole["images"]):
        for share in shares:
            torch.testing.assert_close(
                share["images"][number], expected[share["cameras"]], rtol=tolerance, atol=tolerance
            )
    for name in ("means2d_grad", "absgrad") if options.get("absgrad") else ("means2d_grad",):
        for share in shares:
            expected = whole[name][share["order"]][:, share["share"]]
            torch.testing.assert_close(share[name], expected, rtol=tolerance, atol=tolerance * expected.abs().max())
    for share in shares:
        assert torch.equal(share["radii"], whole["radii"][share["order"]][:, share["share"]])
        assert share["keys"] == sorted([*whole["keys"], "sizes"])
    assert sum(share["num_nonfinite"] for share in shares) == whole["num_nonfinite"] == 1


def test_what_finds_no_room_is_told(ranks: Ranks) -> None:
    """With too little room Gaussians are missing, gradients of the others stay finite, and every rank can tell."""
    shares = ranks.run(work.divided, 2, "plain", {}, False, torch.float64, 0.5)
    whole = work.undivided("plain", {}, torch.float64)
    for share in shares:
        assert share["overflow"] == 1.0
        assert share["is_short"]
        expected = whole["images"][1][share["cameras"]]
        assert share["images"][1].isfinite().all()
        assert share["images"][1].sum() < expected.sum()
        gradient = share["gradients"]["means"]
        assert gradient.isfinite().all()
        assert 0 < (gradient != 0).any(dim=1).sum() < len(gradient)


def test_every_rank_may_have_images_of_its_own_size(ranks: Ranks) -> None:
    """Each gets its size, with what one process would render at it."""
    whole = work.scene()
    gaussians = [whole[name] for name in ("means", "quats", "scales", "opacities", "features")]
    for rank, calls in enumerate(ranks.run(work.different_sizes, 3)):
        for size, image in calls:
            shown = slice(rank, rank + 1)
            expected, _, _ = rasterization(*gaussians, whole["viewmats"][shown], whole["Ks"][shown], *size)
            torch.testing.assert_close(image, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("idle", [False, True])
def test_median_depths_are_those_of_one_process(ranks: Ranks, idle: bool) -> None:
    """Of the Gaussians of all ranks; a rank without a camera has no image."""
    expected = work.median_depths_of(list(range(work.CAMERAS)), work.scene())
    assert (expected > 0).any()
    for cameras, found in ranks.run(work.divided_median_depths, 3, idle):
        assert found.shape == (len(cameras), work.HEIGHT, work.WIDTH)
        torch.testing.assert_close(found, expected[cameras], rtol=1e-5, atol=0)


@pytest.mark.parametrize(("cameras", "dtype"), [([0, 1, 2], torch.float64), ([3, 4, 1], torch.float32)])
def test_every_rank_may_have_a_lens_of_its_own(ranks: Ranks, cameras: list[int], dtype: torch.dtype) -> None:
    """Distorted, fisheye, with a rolling shutter, orthographic or none; gradients reach lenses and cameras."""
    whole = work.undivided_lenses(cameras, dtype)
    shares = ranks.run(work.divided_lenses, 3, cameras, dtype)
    tolerance = 2e-5 if dtype == torch.float32 else 1e-11
    for share, image, camera in zip(shares, whole["images"], whole["cameras"], strict=True):
        assert image.abs().max() > 0.1
        torch.testing.assert_close(share["image"], image, rtol=tolerance, atol=tolerance)
        assert share["camera"].keys() == camera.keys()
        for name, expected in camera.items():
            atol = tolerance * expected.abs().max()
            torch.testing.assert_close(share["camera"][name], expected, rtol=tolerance, atol=atol, msg=name)
        for name, expected in whole["gradients"].items():
            found, atol = share["gradients"][name], tolerance * expected.abs().max()
            torch.testing.assert_close(found, expected[share["share"]], rtol=tolerance, atol=atol, msg=name)


def test_several_scenes_are_refused(ranks: Ranks) -> None:
    """One scene is divided, as in gsplat."""
    assert "one scene" in ranks.run(work.refused_batch, 1)[0]


def test_a_process_without_a_group_is_told_to_join_one() -> None:
    """Nothing hangs, and nothing is rendered of one share alone."""
    with pytest.raises(UserError, match="process group") as caught:
        work.render(work.scene(), "plain", {"distributed": True})
    assert "init_process_group" in str(caught.value.hint)
