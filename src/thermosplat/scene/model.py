"""The scene: sets of Gaussians, how they become images, and how a frame of them is rendered.

Three kinds of scenes, by ``ModelConfig.gaussian_sets`` and ``ModelConfig.feature_dim``:

- "shared": one set for all spectra. The opacity α blends SH colours and features, another opacity α_s of a spectrum
  blends the same features; decoders turn the features of each pixel into images (ThermoSplat).
- "shared" with ``feature_dim`` 0: one set with spherical harmonics for every spectrum, each blended by its opacity
  (ThermalGaussian's OMMG, MMOne); of RGB alone it is plain 3DGS.
- "separate": one set per spectrum, each rendered from its spherical harmonics, without features (independent 3DGS).

One traversal blends SH colours and features at α, and features at one more opacity. That is all that RGB and thermal
need. A third opacity takes a traversal of its own; spectra that share α take none. What becomes of that is said by the
spectra's formations (``formations``).
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from thermosplat.config import ModelConfig, TrainConfig
from thermosplat.config.checks import check_config
from thermosplat.datasets.placement import WORLD, Placement
from thermosplat.runs.checkpoint import Checkpoint, SavedModel, damage_explained
from thermosplat.scene.formations.formation import Blended
from thermosplat.scene.formations.saved_formations import as_trained, restored_formations
from thermosplat.scene.formations.scene_formations import Formations
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.harmonic_passes import blend_harmonics
from thermosplat.scene.initial_gaussians import SHARED, initial_gaussians
from thermosplat.scene.lens_distortion import nearest_distorted
from thermosplat.scene.offloaded import GaussiansInView, OffloadedParameter, gaussians_in_view, stored_values
from thermosplat.scene.packed_parameters import num_bytes, pack
from thermosplat.scene.pixel_filter import PixelFilter
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.scene.saved_gaussians import restored_sets
from thermosplat.scene.shared_cameras import views_by_camera
from thermosplat.scene.views import Rendering, blend_features, render_view_depth, render_view_surface
from thermosplat.spectra import model_spectra

if TYPE_CHECKING:
    from thermosplat.datasets.capture import Capture
    from thermosplat.datasets.frame_tensors import ViewTensors

__all__ = ["RenderedFrame", "SceneModel"]

Views = Mapping[str, "ViewTensors"]
Groups = Sequence[Sequence[str]]


class SceneModel(nn.Module):
    """Gaussians of one scene, and the formations of its images.

    Attributes:
        placement: Where the scene lies in the world.
        spectra: What is rendered, by name, in order.
        gaussian_sets: The sets by name: "shared", or one by the name of each spectrum.
        formations: How the image of each spectrum is formed.
        background: Colour behind the SH colours of photographs, shape [3].

    Args:
        config: What is modelled.
        formations: Those of the spectra, in order.
        gaussian_sets: The Gaussians by set name, as ``config.gaussian_sets`` asks for.
        background: RGB background colour in [0, 1].
        unscented: Pinhole cameras see the Gaussians by the unscented transform, as lenses and rolling shutters do. For
            scenes that are trained through these: the linearisation shows what training has never seen.
        placement: Where the scene, whose frame Gaussians, views and depths have, lies in the world of the capture's own
            poses.
    """

    background: Tensor

    def __init__(
        self,
        config: ModelConfig,
        formations: Formations,
        gaussian_sets: dict[str, Gaussians],
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        *,
        unscented: bool = False,
        placement: Placement = WORLD,
    ) -> None:
        super().__init__()
        self.config = config
        self.spectra = formations.spectra
        self.gaussian_sets = nn.ModuleDict(gaussian_sets)
        self.formations = formations
        self.register_buffer("background", torch.tensor(background, dtype=torch.float32), persistent=False)
        self.unscented = unscented
        self.placement = placement
        self._has_background = any(channel != 0.0 for channel in background)

    def gaussians(self, name: str) -> Gaussians:
        """The set of Gaussians of that name.

        Args:
            name: "shared", or a spectrum's name.

        Raises:
            KeyError: The model has no such set.
        """
        gaussians = self.gaussian_sets[name]
        if not isinstance(gaussians, Gaussians):
            raise TypeError(f"gaussian_sets[{name!r}] is {type(gaussians).__name__}, not Gaussians.")
        return gaussians

    def set_of(self, spectrum: str) -> str:
        """Name of the set of Gaussians that renders a spectrum."""
        return spectrum if spectrum in self.gaussian_sets else SHARED

    @property
    def has_features(self) -> bool:
        """Whether Gaussians have latent features."""
        return self.config.feature_dim > 0

    @property
    def device(self) -> torch.device:
        """Where the scene lies."""
        return next(self.gaussian_sets.parameters()).device

    @property
    def num_gaussians(self) -> int:
        """Gaussians in all sets together."""
        return sum(len(self.gaussians(name)) for name in self.gaussian_sets)

    @property
    def num_bytes(self) -> int:
        """Bytes of all parameters as a checkpoint stores them: without zeros of SH bands and opacity offsets."""
        stored = self.checkpoint_state()
        return sum(num_bytes(values) for values in [*stored.gaussian_sets.values(), stored.decoders or {}])

    @property
    def pixel_filter(self) -> PixelFilter:
        """How footprints are widened, in every render."""
        return PixelFilter(self.config.eps2d)

    # ---- rendering ---------------------------------------------------------------------------------------------------

    def render(
        self,
        views: Views,
        *,
        sh_degree: int,
        absgrad: bool = False,
        shared_cameras: Groups | None = None,
        deterministic: bool = False,
        depth_spread_limit: float | None = None,
        distributed: bool = False,
        shaped_by: Collection[str] | None = None,
    ) -> RenderedFrame:
        """Render one frame: the spectra whose views are given.

        A shared set renders views of one camera together, different cameras by calls of their own.

        Args:
            views: Camera of the image by spectrum. Spectra that are not modelled are left out.
            sh_degree: Highest degree of the spherical harmonics to use now.
            absgrad: Also accumulate absolute means2d gradients (``info["means2d"].absgrad``).
            shared_cameras: Spectra in groups whose views share camera, pose and size. None: compare them. A group for
                each is always right, and keeps the spectra's gradients of means2d apart.
            deterministic: As the rasterizer's.
            depth_spread_limit: Also blend depths, and measure how far they spread along rays, counting hardly more than
                this (``DEPTH_SPREAD_LIMIT``); None: do not. A model without features never does.
            distributed: Each rank holds a share of the Gaussians and renders a frame of its own (``rasterization``).
            shaped_by: Spectra whose images shape a shared set. From those of the others, where they have cameras of
                their own, no gradient reaches means, quats, scales and opacities, and density control sees nothing.
                None: all shape it.
        """
        views = {name: self.seen(views[name]) for name in self.spectra if name in views}
        backgrounds = self.background[None] if self._has_background else None
        how = Rendering(
            sh_degree,
            absgrad,
            self.pixel_filter,
            backgrounds,
            deterministic,
            depth_spread_limit=depth_spread_limit,
            distributed=distributed,
            needs_depth=any(self.formations[name].needs_depth for name in views),
        )
        if SHARED not in self.gaussian_sets:
            shared_cameras, shaped_by = [[name] for name in views], None
        elif shared_cameras is None:
            shared_cameras = views_by_camera(views)
        sets = {name: self._to_render(name, views, shared_cameras, sh_degree) for name in self.gaussian_sets}
        rendered = RenderedFrame(
            in_view={name: some for name, some in sets.items() if isinstance(some, GaussiansInView)}
        )
        for group in shared_cameras:
            names = [name for name in self.spectra if name in group and name in views]
            how = how._replace(geometry_held=shaped_by is not None and not set(names) & set(shaped_by))
            if names:
                self.formations.form(self._blended(sets, names, views[names[0]], how, rendered), rendered)
        for name, view in views.items():
            if view.distortion is not None:
                rendered.bend(name, view.K, view.distortion)
        return rendered

    def seen(self, view: "ViewTensors") -> "ViewTensors":
        """The view, with the projection that the scene was trained with."""
        return replace(view, unscented=True) if self.unscented else view

    def _to_render(self, name: str, views: Views, groups: Groups, sh_degree: int) -> Gaussians:
        """What of a set is rendered for these views, in groups that share a camera: all, or where steps use rows of one
        of its parameters, what is in view."""
        firsts = (next((spectrum for spectrum in group if spectrum in views), None) for group in groups)
        cameras = [views[spectrum] for spectrum in firsts if spectrum is not None and self.set_of(spectrum) == name]
        gaussians = self.gaussians(name)
        if cameras and any(isinstance(value, OffloadedParameter) for value in gaussians.parameters()):
            return gaussians_in_view(gaussians, cameras, sh_degree, self.pixel_filter)
        return gaussians

    def _blended(
        self,
        sets: Mapping[str, Gaussians],
        names: Sequence[str],
        view: "ViewTensors",
        how: Rendering,
        rendered: RenderedFrame,
    ) -> dict[str, Blended]:
        """What is blended for spectra of one camera."""
        if self.has_features:
            photograph = next((name for name in names if self.formations[name].takes_colors), None)
            return blend_features(sets[SHARED], names, photograph, view, how, rendered)
        spectra = [self.spectra[name] for name in names]
        return blend_harmonics(sets, spectra, view, how, rendered, leading=next(iter(self.spectra)))

    def render_depth(
        self, spectrum: str, view: "ViewTensors", *, expected: bool = False, distributed: bool = False
    ) -> Tensor:
        """How far away along z a spectrum sees what it sees, [H, W]; 0 where it sees nothing.

        Depths are in units of the scene: times ``placement.unit`` in world units.

        It is the median: half of what a pixel shows lies before it. What lies behind a surface that is not quite opaque
        does not move it.

        Args:
            spectrum: Its opacity weighs the Gaussians; with separate sets, its own set.
            view: Camera and pose.
            expected: The mean Σ w z / Σ w in place of the median: by it a pixel moves when the camera does.
        """
        if not expected:
            return self.render_surface(spectrum, view, distributed=distributed)[0]
        gaussians = self.gaussians(self.set_of(spectrum))
        how = Rendering(0, False, self.pixel_filter, None, distributed=distributed)
        depth = render_view_depth(gaussians, gaussians.logits_in(spectrum), self.seen(view), how)
        return depth if view.distortion is None else nearest_distorted(depth, view.K, view.distortion)

    def render_surface(self, spectrum: str, view: "ViewTensors", *, distributed: bool = False) -> tuple[Tensor, Tensor]:
        """The depth of ``render_depth``, and where the spectrum's opacity is a half or more, both [H, W].

        Args:
            spectrum: Its opacity weighs the Gaussians; with separate sets, its own set.
            view: Camera and pose.
        """
        gaussians = self.gaussians(self.set_of(spectrum))
        how = Rendering(0, False, self.pixel_filter, None, distributed=distributed)
        found = render_view_surface(gaussians, gaussians.logits_in(spectrum), self.seen(view), how)
        if view.distortion is None:
            return found
        depth, covered = (nearest_distorted(image, view.K, view.distortion) for image in found)
        return depth, covered

    # ---- making and restoring ----------------------------------------------------------------------------------------

    @classmethod
    def from_capture(cls, config: TrainConfig, capture: "Capture", device: torch.device | str) -> "SceneModel":
        """A model at the start of training; the same for the same seed, whatever was drawn before.

        Args:
            config: The whole configuration: spectra, model, decoders, SH degree, background and seed.
            capture: The capture, for its sparse points and for what its images are.
            device: Where the model shall live.

        Raises:
            UserError: If the configuration contradicts itself, or the capture lacks images of a spectrum that is to be
                modelled, or points to start from.
        """
        check_config(config)
        capture.require(list(config.modelled))
        spectra = model_spectra(config.modelled, {name: capture.scales[name].kind for name in config.modelled})
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            formations = Formations(config.model, config.decoder, spectra)
        for name in config.modelled:
            views = [frame.views[name] for frame in capture.train if name in frame.views]
            formations[name].begin(capture.scales[name], views)
        model = cls(
            config.model,
            formations,
            initial_gaussians(config, capture, formations),
            config.background,
            unscented=capture.unscented,
            placement=capture.placement,
        )
        return model.to(device)

    def checkpoint_state(self) -> SavedModel:
        """The model of a checkpoint, which ``from_checkpoint`` restores."""
        return SavedModel(
            gaussian_sets={name: pack(stored_values(self.gaussians(name))) for name in self.gaussian_sets},
            decoders=self.formations.state_dict() or None,
            color_spaces={name: spectrum.color_space for name, spectrum in self.spectra.items()},
            unscented=self.unscented,
            placement=self.placement.state(),
        )

    @classmethod
    def from_checkpoint(cls, checkpoint: Checkpoint, device: torch.device | str) -> "SceneModel":
        """The model of a checkpoint.

        Args:
            checkpoint: Its configuration and model are used.
            device: Where the model shall live.

        Raises:
            UserError: It is incomplete, or its parts do not fit together.
        """
        config, saved = checkpoint.config, checkpoint.model
        with damage_explained("model"):
            spectra = model_spectra(as_trained(config.modelled, saved.decoders), saved.color_spaces)
            formations = restored_formations(saved.decoders, config.model, config.decoder, spectra)
            model = cls(
                config.model,
                formations,
                restored_sets(saved.gaussian_sets, config, formations),
                config.background,
                unscented=saved.unscented,
                placement=Placement.from_state(saved.placement),
            )
        return model.to(device)
