"""The scene model: sets of Gaussians, decoders, and how a frame is rendered from them.

Three kinds of model, by ``ModelConfig.gaussian_sets`` and ``ModelConfig.feature_dim``:

- "shared": one set for all spectra. The opacity α blends SH colours and features, another opacity α_s of a spectrum
  blends the same features; decoders turn the features of each pixel into images (ThermoSplat).
- "shared" with ``feature_dim`` 0: one set with spherical harmonics for every spectrum, each blended by its opacity
  (ThermalGaussian's OMMG, MMOne); of RGB alone it is plain 3DGS.
- "separate": one set per spectrum, each rendered from its spherical harmonics, without features (independent 3DGS).

One traversal blends SH colours and features at α, and features at one more opacity. That is all that RGB and thermal
need. A third opacity takes a traversal of its own; spectra that share α take none.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from thermosplat.config import DecoderConfig, ModelConfig, TrainConfig
from thermosplat.config.checks import check_config
from thermosplat.datasets.placement import WORLD, Placement
from thermosplat.fused.covered_images import warp_covered
from thermosplat.runs.checkpoint import Checkpoint, SavedModel, damage_explained
from thermosplat.scene.decoders import Decoders, may_be_hybrid
from thermosplat.scene.decoding_in_parts import decode_in_parts
from thermosplat.scene.feature_passes import blend_features
from thermosplat.scene.fourier_features import with_fourier_features
from thermosplat.scene.gaussians import Gaussians
from thermosplat.scene.gaussians_in_view import GaussiansInView, gaussians_in_view
from thermosplat.scene.harmonic_passes import render_harmonics
from thermosplat.scene.initial_gaussians import SHARED, initial_gaussians
from thermosplat.scene.lens_distortion import nearest_distorted
from thermosplat.scene.offloaded import stored_values
from thermosplat.scene.packed_parameters import num_bytes, pack
from thermosplat.scene.pixel_filter import PixelFilter
from thermosplat.scene.rendered_frame import RenderedFrame
from thermosplat.scene.saved_gaussians import restored_sets
from thermosplat.scene.shared_cameras import views_by_camera
from thermosplat.scene.spectrum_decoders import SpectrumDecoders, make_decoders
from thermosplat.scene.view_directions import view_directions
from thermosplat.scene.views import (
    Rendering,
    render_view_depth,
)
from thermosplat.spectra import Spectrum, SpectrumConfig, model_spectra

if TYPE_CHECKING:
    from thermosplat.datasets.capture import Capture
    from thermosplat.datasets.frame_tensors import ViewTensors

__all__ = ["RenderedFrame", "SceneModel"]

Views = Mapping[str, "ViewTensors"]
Groups = Sequence[Sequence[str]]


class SceneModel(nn.Module):
    """Gaussians and decoders of one scene.

    Attributes:
        placement: Where the scene lies in the world.
        spectra: What is rendered, by name, in order.
        gaussian_sets: The sets by name: "shared", or one by the name of each spectrum.
        decoders: The pixel-wise networks; None where the Gaussians have no features.
        background: Colour behind the SH colours of photographs, shape [3].

    Args:
        config: What is modelled, and how.
        decoder: Widths and switches of the decoders.
        spectra: What is rendered, in order.
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
        decoder: DecoderConfig,
        spectra: Sequence[Spectrum],
        gaussian_sets: dict[str, Gaussians],
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        *,
        unscented: bool = False,
        placement: Placement = WORLD,
    ) -> None:
        super().__init__()
        self.config = config
        self.decoder_config = decoder
        self.spectra = {spectrum.name: spectrum for spectrum in spectra}
        self.gaussian_sets = nn.ModuleDict(gaussian_sets)
        self.decoders: Decoders | SpectrumDecoders | None = None
        if config.gaussian_sets == SHARED and config.feature_dim > 0:
            self.decoders = make_decoders(decoder, config.feature_dim, spectra)
        self.register_buffer("background", torch.tensor(background, dtype=torch.float32), persistent=False)
        self.unscented = unscented
        self.placement = placement
        self._has_background = any(channel != 0.0 for channel in background)
        first = spectra[0]
        self.photograph = first.name if may_be_hybrid(first, spectra) else None
        """The spectrum whose image has SH colours in it; None where the first one is no photograph."""

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
    def num_gaussians(self) -> int:
        """Gaussians in all sets together."""
        return sum(len(self.gaussians(name)) for name in self.gaussian_sets)

    @property
    def num_bytes(self) -> int:
        """Bytes of all parameters as a checkpoint stores them: without zeros of SH bands and opacity offsets."""
        stored = self.checkpoint_state()
        return sum(num_bytes(values) for values in [*stored.gaussian_sets.values(), stored.decoders or {}])

    @property
    def feature_channels(self) -> int | None:
        """Latent channels that are blended; None where there are no features."""
        return self.gaussians(SHARED).features.shape[1] if self.decoders is not None else None

    @property
    def offsets_kept(self) -> dict[str, float]:
        """By spectrum with opacity offsets, the share of the Gaussians whose offset is not zero."""
        stored = {
            spectrum: self.gaussians(name).stored_opacity(spectrum)
            for name in self.gaussian_sets
            for spectrum in self.gaussians(name).second_opacities
        }
        return {
            spectrum: (values != 0).float().mean().item()
            for spectrum, (values, is_offset) in stored.items()
            if values is not None and is_offset
        }

    @property
    def point_spreads(self) -> dict[str, float]:
        """By spectrum whose images are blurred, the standard deviation [of an image's width]."""
        return {} if self.decoders is None else self.decoders.point_spreads.widths()

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
                this (``LossConfig.depth_spread_limit``); None: do not. A model without features never does.
            distributed: Each rank holds a share of the Gaussians and renders a frame of its own (``rasterization``).
            shaped_by: Spectra whose images shape a shared set. From those of the others, where they have cameras of
                their own, no gradient reaches means, quats, scales and opacities, and density control sees nothing.
                None: all shape it.

        Returns:
            The images.
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
            if names and self.decoders is not None:
                self._render_features(self.decoders, sets, names, views[names[0]], how, rendered)
            elif names:
                render_harmonics(
                    sets,
                    [self.spectra[name] for name in names],
                    views[names[0]],
                    how,
                    rendered,
                    leading=next(iter(self.spectra)),
                )
        for name, view in views.items():
            if view.distortion is not None:
                rendered.bend(name, view.K, view.distortion)
        return rendered

    def seen(self, view: "ViewTensors") -> "ViewTensors":
        """The view, with the projection that the scene was trained with.

        Args:
            view: Camera and pose.
        """
        return replace(view, unscented=True) if self.unscented else view

    def _to_render(self, name: str, views: Views, groups: Groups, sh_degree: int) -> Gaussians:
        """What of a set is rendered for these views, in groups that share a camera: all, or where some of it is
        offloaded, what is in view."""
        firsts = (next((spectrum for spectrum in group if spectrum in views), None) for group in groups)
        cameras = [views[spectrum] for spectrum in firsts if spectrum is not None and self.set_of(spectrum) == name]
        return gaussians_in_view(self.gaussians(name), cameras, sh_degree, self.pixel_filter)

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
            distributed: As in ``render``.
        """
        gaussians = self.gaussians(self.set_of(spectrum))
        how = Rendering(0, False, self.pixel_filter, None, distributed=distributed)
        depth = render_view_depth(gaussians, gaussians.logits_in(spectrum), self.seen(view), how, expected=expected)
        if view.distortion is None:
            return depth
        return nearest_distorted(depth, view.K, view.distortion)

    def _render_features(
        self,
        decoders: Decoders | SpectrumDecoders,
        sets: Mapping[str, Gaussians],
        names: Sequence[str],
        view: "ViewTensors",
        how: Rendering,
        rendered: RenderedFrame,
    ) -> None:
        """Spectra of one camera: features blended at each opacity, then decoded."""
        features, colors = blend_features(sets[SHARED], names, self.photograph, view, how, rendered)
        if not view.orthographic:  # a map, which no camera takes
            features = {name: decoders.point_spreads(name, image) for name, image in features.items()}
            if colors is not None and self.photograph is not None:
                colors = decoders.point_spreads(self.photograph, colors)
        decoded = decode_in_parts(decoders, {name: self.decoder_input(view, features[name]) for name in names})
        for name in sorted(names, key=lambda name: name == self.photograph):  # the photograph last
            hybrid = name == self.photograph and self.decoder_config.hybrid
            image = decoded[name] if hybrid else self._padded(decoded[name])  # a sum has no range to widen
            base = None
            if hybrid:
                base = colors
            elif name == self.photograph and self.decoder_config.covered_only:
                base = (1.0 - rendered.alphas[name]) * self.background
            rendered.images[name] = self._covered(image, rendered.alphas[name], base)
            rendered.features[name] = features[name]

    def _padded(self, decoded: Tensor) -> Tensor:
        """A decoded image, in (0, 1), in a range that is wider by the padding on both sides (Mip-NeRF)."""
        padding = self.decoder_config.padding
        return decoded if padding == 0 else (1.0 + 2.0 * padding) * decoded - padding

    def _covered(self, decoded: Tensor, alpha: Tensor, base: Tensor | None) -> Tensor:
        """A decoded image as far as Gaussians cover it, added to ``base``, or black, the lowest value."""
        if not self.decoder_config.covered_only:
            return decoded if base is None else base + decoded
        if decoded.is_cuda:
            return warp_covered(decoded, alpha, base)
        covered = alpha * decoded
        return covered if base is None else base + covered

    def decoder_input(self, view: "ViewTensors | None", features: Tensor) -> Tensor:
        """Features as the decoders take them: with waves of them and the viewing directions, where they see those.

        Args:
            view: From where the features were rendered; None: from nowhere, which is the direction 0.
            features: A_f, shape [H, W, d]; without a view any shape [..., d].
        """
        inputs = with_fourier_features(features, self.decoder_config.fourier_frequency)
        if not self.decoder_config.view_direction:
            return inputs
        if view is None:
            return torch.nn.functional.pad(inputs, (0, 3))
        return torch.cat([inputs, view_directions(view)], dim=-1)

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
        gaussian_sets = initial_gaussians(config, capture, spectra)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            model = cls(
                config.model,
                config.decoder,
                spectra,
                gaussian_sets,
                config.background,
                unscented=capture.unscented,
                placement=capture.placement,
            )
        return model.to(device)

    def checkpoint_state(self) -> SavedModel:
        """The model of a checkpoint, which ``from_checkpoint`` restores."""
        return SavedModel(
            gaussian_sets={name: pack(stored_values(self.gaussians(name))) for name in self.gaussian_sets},
            decoders=self.decoders.state_dict() if self.decoders is not None else None,
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
            gaussian_sets = restored_sets(saved.gaussian_sets, config, spectra)
            if config.model.gaussian_sets == SHARED and config.model.feature_dim > 0:
                _check_decoders(saved.decoders, config, spectra)
            model = cls(
                config.model,
                config.decoder,
                spectra,
                gaussian_sets,
                config.background,
                unscented=saved.unscented,
                placement=Placement.from_state(saved.placement),
            )
            if model.decoders is not None and saved.decoders is not None:
                model.decoders.load_state_dict(saved.decoders)
        return model.to(device)


def as_trained(
    spectra: Mapping[str, SpectrumConfig], decoders: Mapping[str, Tensor] | None
) -> dict[str, SpectrumConfig]:
    """The spectra by name with the blur that a saved model has, or has not: noise decides no more.

    Args:
        spectra: As they were asked for.
        decoders: The saved decoders; None: there are none.
    """
    saved = decoders or {}
    trained = dict(spectra)
    for name, one in spectra.items():
        if one.point_spread_noise > 0:
            learnt = f"point_spreads.log_widths.{name}" in saved
            trained[name] = replace(one, point_spread=one.point_spread if learnt else 0.0, point_spread_noise=0.0)
    return trained


def _check_decoders(saved: Mapping[str, Tensor] | None, config: TrainConfig, spectra: Sequence[Spectrum]) -> None:
    """Hold the shapes of saved decoders against the configuration, before memory is taken for what that asks for."""
    with torch.device("meta"):
        asked = make_decoders(config.decoder, config.model.feature_dim, spectra).state_dict()
    shapes = {name: list(value.shape) for name, value in (saved or {}).items()}
    for name, value in asked.items():
        if shapes.get(name) != list(value.shape):
            raise ValueError(f"decoders.{name} has the shape {shapes.get(name)}, not {list(value.shape)}")
