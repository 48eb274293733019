"""Fixtures every test folder may use."""

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def device(request: pytest.FixtureRequest) -> torch.device:
    """Each device the renderer runs on; the CUDA half is marked ``cuda`` and skipped where there is none."""
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a CUDA device; torch finds none")
    return torch.device(request.param)


@pytest.fixture
def gsplat_reference() -> Iterator[Callable[..., Any]]:
    """gsplat 1.5.3's own torch reference of ``rasterization``, made to run in float64 on the CPU.

    The few CUDA calls in it are replaced by the oracle found at ``THERMOSPLAT_TEST_ORACLE`` (or ``../shared/oracle``
    beside the repository); gsplat is restored afterwards.
    """
    folder = Path(os.environ.get("THERMOSPLAT_TEST_ORACLE", REPOSITORY.parent / "shared" / "oracle"))
    if not (folder / "gsplat_oracle.py").is_file():
        pytest.skip(f"no gsplat_oracle.py in {folder}; set THERMOSPLAT_TEST_ORACLE to the folder that holds it")
    pytest.importorskip("gsplat", reason="gsplat 1.5.3 is not installed (pip install --no-deps gsplat==1.5.3)")
    from gsplat import rendering
    from gsplat.cuda import _wrapper

    saved = [
        (_wrapper, "rasterize_to_indices_in_range", _wrapper.rasterize_to_indices_in_range),
        (rendering, "isect_tiles", rendering.isect_tiles),
        (rendering, "isect_offset_encode", rendering.isect_offset_encode),
        (rendering, "spherical_harmonics", rendering.spherical_harmonics),
    ]
    nerfacc = sys.modules.get("nerfacc")
    default_dtype = torch.get_default_dtype()
    sys.path.insert(0, str(folder))
    try:
        import gsplat_oracle

        torch.set_default_dtype(torch.float64)
        yield gsplat_oracle.install()
    finally:
        torch.set_default_dtype(default_dtype)
        sys.path.remove(str(folder))
        for module, name, value in saved:
            setattr(module, name, value)
        if nerfacc is None:
            sys.modules.pop("nerfacc", None)
        else:
            sys.modules["nerfacc"] = nerfacc
