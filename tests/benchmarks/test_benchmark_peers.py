"""The peers of the rasterization benchmark: what they are compared by, and what they compute."""

import math

import pytest
import torch

import reference_rasterizer
from measuring.agreement import OTHER_CONVENTIONS, SAME_CONVENTIONS, differences, disagreement, largest
from measuring.fragments import count_fragments
from peers.gswarp import projection_matrix
from peers.peer import CASES
from peers.renderers import CALLABLE, GRAPH, OURS, callable_peer, float64_renderer, graph_peer, thermosplat_peer
from peers.torch_renderer import torch_peer
from rasterization.case import inputs_of, run_case
from rasterization.passes import Passes
from scenes.benchmark_scenes import BenchmarkScene, huge_scene, synthetic_scene
from warp_kernels.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

WIDTH, HEIGHT = 37, 21


def float64_inputs(scene: BenchmarkScene, case: str) -> dict[str, torch.Tensor]:
    """The case's tensors in float64."""
    inputs = inputs_of(scene, case, WIDTH, HEIGHT, torch.device("cpu"))
    return {k: v.detach().double().requires_grad_(v.requires_grad) for k, v in inputs.items()}


@pytest.mark.parametrize("case", [case for case in CASES if case != "features32"])
def test_plain_torch_and_float64_kernels_are_one_renderer(case: str) -> None:
    """The plain torch renderer and the truth, which splits channels and opacities, give the same numbers."""
    inputs = float64_inputs(synthetic_scene(80), case)
    one, other = (
        Passes(renderer(case, inputs, WIDTH, HEIGHT), inputs).forward_backward()
        for renderer in (torch_peer().renderer, float64_renderer())
    )
    names = [name for name, tensor in inputs.items() if tensor.requires_grad]
    found = differences(one, other, names, 1e-9)
    assert found["image_max"] < 1e-10
    assert max(value for name, value in found.items() if name.startswith("grad_")) < 1e-9


def test_plain_torch_renderer_matches_the_dense_reference() -> None:
    """Cutting the image into tiles changes nothing; it is wider than one."""
    inputs = float64_inputs(huge_scene(800), "features8")
    (image, alphas), _ = torch_peer().renderer("features8", inputs, WIDTH, HEIGHT)()
    true, true_alphas, _ = reference_rasterizer.rasterization(
        inputs["means"],
        inputs["quats"],
        inputs["scales"],
        inputs["opacities"],
        inputs["features"],
        inputs["viewmats"],
        inputs["Ks"],
        WIDTH,
        HEIGHT,
    )
    assert (image - true).abs().max() < 1e-12
    assert (alphas - true_alphas).abs().max() < 1e-12


def test_fragments_are_counted_as_the_rules_say() -> None:
    """The counts equal those of a brute-force pass over all Gaussians at all pixels, without tiles."""
    inputs = inputs_of(huge_scene(700), "rgbt", WIDTH, HEIGHT, torch.device("cpu"))
    info = thermosplat_peer().renderer("rgbt", inputs, WIDTH, HEIGHT)().infos[0]
    counted = count_fragments(info, WIDTH, HEIGHT)

    visible = (info["radii"][0] > 0).all(-1).nonzero().squeeze(1)
    order = visible[info["depths"][0, visible].argsort(stable=True)]
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    dx = info["means2d"][0, order, 0, None].detach() - x.reshape(-1)
    dy = info["means2d"][0, order, 1, None].detach() - y.reshape(-1)
    xx, xy, yy = info["conics"][0, order, :, None].detach().unbind(1)
    visibility = torch.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy)

    def drawn(opacities: torch.Tensor) -> torch.Tensor:
        alphas = (opacities[0, order, None].detach() * visibility).clamp(max=ALPHA_MAX)
        seen = alphas >= ALPHA_MIN
        return seen & (torch.cumprod(torch.where(seen, 1 - alphas, 1.0), 0) > TRANSMITTANCE_MIN)

    first, second = drawn(info["opacities"]), drawn(info["thermal_opacities"])
    # Two roundings may decide differently at a threshold, in a fragment or two of thousands.
    assert counted.drawn == pytest.approx(int(first.sum()), abs=2)
    assert counted.thermal == pytest.approx(int(second.sum()), abs=2)
    assert counted.either == pytest.approx(int((first | second).sum()), abs=4)
    assert counted.drawn > 2000
    assert counted.listed >= counted.either
    assert counted.longest <= counted.visible <= len(order)


def test_a_peer_that_fails_loses_no_other() -> None:
    """There is no CUDA graph of the CPU: the row says so, and has the other renderers' times."""
    cpu, peers = torch.device("cpu"), [thermosplat_peer(), callable_peer(), graph_peer(), torch_peer()]
    row = run_case(synthetic_scene(40), "rgb", (WIDTH, HEIGHT), cpu, peers, 1, with_truth=False, peaks=None)
    assert list(row["left_out"]) == [CALLABLE, GRAPH]
    assert list(row["forward"]) == list(row["forward_backward"]) == [OURS, "plain torch"]


@pytest.mark.cuda
@pytest.mark.parametrize("case", ["rgb", "rgbt"])
def test_graphs_render_the_same(case: str) -> None:
    """Replays give the eager images and gradients, and count the same pairs."""
    device = torch.device("cuda")
    row = run_case(
        synthetic_scene(5000),
        case,
        (320, 240),
        device,
        [thermosplat_peer(), callable_peer(), graph_peer()],
        2,
        with_truth=True,
        peaks=None,
    )
    assert row["left_out"] == row["apart"] == {}
    assert row["peak_memory_mib"][GRAPH] > 0
    eager = row["error_to_float64"][OURS]
    for name in (CALLABLE, GRAPH):
        assert row["intersections"][name] == row["intersections"][OURS] > 5000
        error = row["error_to_float64"][name]
        assert error["image_rms"] == pytest.approx(eager["image_rms"])
        assert error == pytest.approx(eager, rel=0.1, abs=1e-6)  # gradients are summed in another order each time


def test_projection_matrix_reaches_the_same_pixels_as_the_intrinsics() -> None:
    """3DGS's route from clip space to pixel indices lands half a pixel left of the position K gives."""
    K = torch.tensor([[310.0, 0, 161.5], [0, 290.0, 95.25], [0, 0, 1]], dtype=torch.float64)
    points = torch.randn(50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    points[:, 2] = 1.5 + points[:, 2].abs()
    homogeneous = torch.cat([points, torch.ones(50, 1, dtype=torch.float64)], 1)
    clip = homogeneous @ projection_matrix(K, 320, 200).T
    ndc = clip[:, :2] / clip[:, 3:]
    indices = ((ndc + 1) * torch.tensor([320, 200]) - 1) / 2
    pixels = (points @ K.T)[:, :2] / points[:, 2:]
    assert (indices + 0.5 - pixels).abs().max() < 1e-9


def test_disagreement_names_what_is_off() -> None:
    """Wrong images, wrong gradients and numbers that are not finite are told; rounding is not."""
    image, gradient = torch.rand(1, 20, 30, 4), torch.randn(50, 3)
    same = ([image + 1e-6], (gradient * (1 + 1e-5),))
    darker, broken, steeper = (
        ([image * 0.9], (gradient,)),
        ([image * math.nan], (gradient,)),
        ([image], (2 * gradient,)),
    )

    def told(other: tuple) -> str | None:
        found = differences(other, ([image], (gradient,)), ["means"], SAME_CONVENTIONS.pixel)
        return disagreement(found, SAME_CONVENTIONS)

    assert told(same) is None
    assert "images differ" in (told(darker) or "")
    assert "images differ" in (told(broken) or "")
    assert "grad_means" in (told(steeper) or "")
    assert OTHER_CONVENTIONS.pixel > SAME_CONVENTIONS.pixel


def test_one_number_that_is_not_finite_is_the_largest_difference() -> None:
    """Whichever of the images or gradients it is in, and however few there are."""
    assert largest([1.0, 3.0, 2.0]) == 3.0
    assert math.isnan(largest([1.0, math.nan, 2.0]))
    image, alphas, gradient = torch.rand(1, 40, 50, 3), torch.rand(1, 40, 50, 1), torch.randn(5, 3)
    truth = [image, alphas], (gradient,)
    for place in (0, 1):
        broken = [image.clone(), alphas.clone()]
        broken[place][0, 0, 0, 0] = math.nan
        assert math.isnan(differences((broken, (gradient,)), truth, ["means"], SAME_CONVENTIONS.pixel)["image_max"])
