"""Which of the peers are installed, and how the others are."""

from collections.abc import Callable, Collection
from importlib.metadata import version

from peers.peer import Peer
from peers.renderers import callable_peer, eager_peer, graph_peer, gsplat_renderer, thermosplat_peer

INSTALL = {
    "gsplat": "pip install --no-deps gsplat==1.5.3",
    "gsplat-main": "benchmarks/peers/README.md, which builds it into the folder THERMOSPLAT_GSPLAT_MAIN",
    "faster-gs": 'pip install --no-build-isolation "git+https://github.com/nerficg-project/faster-gaussian-splatting'
    '#subdirectory=FasterGSCudaBackend"',
    "gswarp": "pip install --no-deps gswarp==1.1.0",
}
"""How each peer is installed, in one line."""


def gsplat_peer() -> Peer:
    """gsplat 1.5.3's CUDA kernels."""
    import gsplat

    renderer = gsplat_renderer(gsplat.rasterization, gsplat.spherical_harmonics, packed=False)
    return Peer("gsplat", f"gsplat {version('gsplat')}, CUDA kernels", renderer)


def gsplat_main() -> Peer:
    """gsplat's main branch."""
    from peers.gsplat_main import gsplat_main_peer

    return gsplat_main_peer()


def faster_gs() -> Peer:
    """Faster-GS."""
    from peers.faster_gs import faster_gs_peer

    return faster_gs_peer()


def gswarp() -> Peer:
    """gswarp."""
    from peers.gswarp import gswarp_peer

    return gswarp_peer()


MAKERS: dict[str, Callable[[], Peer]] = {
    "gsplat": gsplat_peer,
    "gsplat-main": gsplat_main,
    "faster-gs": faster_gs,
    "gswarp": gswarp,
}
"""Other projects by the names that ``--peers`` takes, in the order of the tables."""


def others(names: Collection[str]) -> list[Peer]:
    """Those of the named that are installed; of the others a line says how they are installed.

    Args:
        names: keys of ``MAKERS``, and others, which are passed over.
    """
    found = []
    for name, make in MAKERS.items():
        if name not in names:
            continue
        try:
            found.append(make())
        except ImportError as error:
            print(f"{name} is left out ({error}). Install it: {INSTALL[name]}", flush=True)
    return found


def cuda_peers(names: Collection[str]) -> list[Peer]:
    """thermosplat and, of those named and installed, itself captured and other projects.

    Args:
        names: of ``renderers.PEERS``, of ``MAKERS``, or "deterministic".
    """
    peers = [thermosplat_peer()]
    if "callable" in names:
        peers.append(callable_peer())
    if "graph" in names:
        peers.append(graph_peer())
    if "eager" in names:
        peers.append(eager_peer())
    peers += others(names)
    if "deterministic" in names:
        peers.append(thermosplat_peer(deterministic=True))
    return peers
