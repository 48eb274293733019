"""One case of bench_rasterization.py: a scene, a size and a set of channels, checked and then timed."""

import time
import traceback
from typing import Any

import torch

from measuring.agreement import differences, disagreement
from measuring.device_peaks import DevicePeaks
from measuring.floors import stage_floors
from measuring.fragments import count_fragments
from measuring.stages import blended_channels, stage_times
from measuring.timing import time_interleaved
from peers.peer import Peer, Rendered, Renderer, Tensors
from peers.renderers import float64_renderer, thermosplat_peer
from rasterization.captured_passes import CapturedPasses, GraphedPasses
from rasterization.passes import Passes, Result
from scenes.benchmark_scenes import BenchmarkScene
from warp_kernels.machinery.launching import num_threads, set_num_threads


def inputs_of(scene: BenchmarkScene, case: str, width: int, height: int, device: torch.device) -> Tensors:
    """The case's tensors on the device, as leaves."""
    tensors = {"means": scene.means, "quats": scene.quats, "scales": scene.scales, "opacities": scene.opacities}
    if case in ("rgb", "rgbt"):
        tensors["sh"] = scene.sh
    if case != "rgb":
        tensors["features"] = scene.features(8 if case == "rgbt" else int(case.removeprefix("features")))
    if case == "rgbt":
        tensors["thermal_opacities"] = scene.thermal_opacities
    leaves = {name: tensor.to(device, copy=True).requires_grad_() for name, tensor in tensors.items()}
    leaves["viewmats"] = scene.viewmat[None].to(device)
    leaves["Ks"] = scene.intrinsics(width, height)[None].to(device)
    return leaves


def run_case(
    scene: BenchmarkScene,
    case: str,
    size: tuple[int, int],
    device: torch.device,
    peers: list[Peer],
    repeats: int,
    *,
    with_truth: bool,
    peaks: DevicePeaks | None,
    cores: list[int] | None = None,
) -> dict[str, Any]:
    """Checks and times one case.

    Args:
        scene: Gaussians and camera.
        case: one of ``peers.CASES``.
        size: width and height [px].
        device: where to render.
        peers: thermosplat first. One that fails is left out, and one that renders something else marked.
        repeats: measurements of each call.
        with_truth: compare with the float64 kernels too.
        peaks: for the floors; None: neither stages nor floors.
        cores: numbers of CPU threads to time thermosplat with.

    Returns:
        The row.
    """
    width, height = size
    inputs = inputs_of(scene, case, width, height, device)
    row: dict[str, Any] = {
        "scene": scene.name,
        "gaussians": len(scene.means),
        "size": f"{width}x{height}",
        "case": case,
    }
    peers = [peer for peer in peers if case in peer.cases]
    start_s = time.perf_counter()
    passes = _checked(peers, case, inputs, size, with_truth, row)
    row["checks_s"] = round(time.perf_counter() - start_s, 2)

    row["forward"] = time_interleaved({name: p.forward for name, p in passes.items()}, device, repeats)
    row["forward_backward"] = time_interleaved(
        {name: p.forward_backward for name, p in passes.items()}, device, repeats
    )
    row["intersections"] = {name: p.intersections for name, p in passes.items()}
    row["peak_memory_mib"] = {}
    for peer in peers:
        if peer.name in passes:
            peer.release()
            row["peak_memory_mib"][peer.name] = passes[peer.name].peak_memory(device)
            peer.release()
    ours = passes[peers[0].name]
    if cores:
        row["cores"] = _scaling(ours, cores, device, repeats)
    if peaks is not None:
        try:
            row |= _stages(ours.forward(), inputs, size, repeats, peaks)
        except Exception as error:  # the stages are steps of the kernels' own interface, which is not the public one
            traceback.print_exc()
            row["stages_error"] = one_line(error)
    return row


def one_line(error: Exception) -> str:
    """What went wrong, for a table."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]


def _checked(
    peers: list[Peer], case: str, inputs: Tensors, size: tuple[int, int], with_truth: bool, row: dict[str, Any]
) -> dict[str, Passes | CapturedPasses]:
    """Compares every peer with thermosplat, and all with float64; returns those that rendered at all."""
    names = [name for name, tensor in inputs.items() if tensor.requires_grad]
    row |= {"error_to_float64": {}, "difference": {}, "left_out": {}, "apart": {}}
    exact = {k: v.detach().double().requires_grad_(v.requires_grad) for k, v in inputs.items()} if with_truth else {}
    references: dict[tuple[float, int | None], Result] = {}
    truths: dict[tuple[float, int | None], Result] = {}
    passes: dict[str, Passes | CapturedPasses] = {}

    def result(renderer: Renderer, tensors: Tensors, num_images: int | None) -> Result:
        return Passes(renderer(case, tensors, *size), tensors, num_images).forward_backward()

    for peer in peers:
        near, seen = peer.near_plane, (peer.near_plane, peer.num_images)
        try:
            made = passes_of(peer, case, inputs, size)
            found = made.forward_backward()
            if peer.raw is not None:
                found = found[0], peer.raw.gradients(inputs, found[1])
        except Exception as error:
            if peer is peers[0]:
                raise
            traceback.print_exc()
            row["left_out"][peer.name] = one_line(error)
            torch.cuda.empty_cache()
            continue
        if peer is peers[0]:
            references[seen] = found
            row["results_mib"] = round(sum(tensor.nbytes for part in found for tensor in part) / 2**20, 1)
        else:
            if seen not in references:
                references[seen] = result(thermosplat_peer(near).renderer, inputs, peer.num_images)
            difference = differences(found, references[seen], names, peer.tolerance.pixel)
            row["difference"][peer.name] = difference
            if (reason := disagreement(difference, peer.tolerance)) is not None:
                row["apart"][peer.name] = reason
        if with_truth:
            if seen not in truths:
                truths[seen] = result(float64_renderer(near), exact, peer.num_images)
            row["error_to_float64"][peer.name] = differences(found, truths[seen], names, peers[0].tolerance.pixel)
        passes[peer.name] = made
    return passes


def passes_of(peer: Peer, case: str, inputs: Tensors, size: tuple[int, int]) -> Passes | CapturedPasses:
    """A peer's calls of a case, captured where the peer is."""
    if peer.raw is not None:
        inputs = peer.raw.leaves(inputs)
    eager = Passes(peer.renderer(case, inputs, *size), inputs)
    if peer.captured == "function":
        return GraphedPasses(eager, inputs)
    return CapturedPasses(eager, inputs["means"].device) if peer.captured == "call" else eager


def _scaling(ours: Passes, cores: list[int], device: torch.device, repeats: int) -> dict[str, dict[str, float]]:
    """Median times [ms] of thermosplat by the number of CPU threads."""
    before, torch_before = num_threads(), torch.get_num_threads()
    times = {}
    for count in cores:
        set_num_threads(count)
        torch.set_num_threads(count)
        calls = {"forward": ours.forward, "forward_backward": ours.forward_backward}
        measured = time_interleaved(calls, device, repeats)
        times[str(count)] = {name: summary["median_ms"] for name, summary in measured.items()}
    set_num_threads(before)
    torch.set_num_threads(torch_before)
    return times


def _stages(
    rendered: Rendered, inputs: Tensors, size: tuple[int, int], repeats: int, peaks: DevicePeaks
) -> dict[str, Any]:
    """Times of the stages, fragments and floors, and the floor of forward plus backward."""
    info = rendered.infos[0]
    fragments = count_fragments(info, *size)
    tiles = info["isect_offsets"].numel()
    floors = stage_floors(
        fragments, len(inputs["means"]), len(info["flatten_ids"]), size, tiles, blended_channels(inputs), peaks
    )
    stages = stage_times(inputs, *size, repeats)
    for name, times in stages.items():
        times |= floors[name]
        times["times_floor"] = times["median_ms"] / times["floor_ms"]
    floor_ms = sum(times["floor_ms"] for times in stages.values())
    return {"stages": stages, "fragments": fragments._asdict(), "floor_ms": floor_ms}
