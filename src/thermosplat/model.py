"""The scene model: sets of Gaussians, decoders, and how a frame is rendered from them.

Three kinds of model, by ``ModelConfig.gaussian_sets`` and ``ModelConfig.feature_dim``:

- "shared": one set for both spectra. The visible opacity α blends SH colours and features, the thermal opacity α_t
  blends the same features; decoders turn the features of each pixel into images (ThermoSplat).
- "shared" with ``feature_dim`` 0: one set with spherical harmonics for either spectrum, the visible ones blended by α,
  the thermal ones by α_t (ThermalGaussian's OMMG, MMOne); of RGB alone it is plain 3DGS.
- "separate": one set a spectrum, each rendered from its spherical harmonics, without features (two independent 3DGS).
"""

from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor, nn

from thermosplat.checkpoint import damage_explained
from thermosplat.config import DecoderConfig, ModelConfig, TrainConfig
from thermosplat.config_checks import check_config
from thermosplat.config_files import from_dict
from thermosplat.decoders import Decoders
from thermosplat.gaussian_views import Rendering, blended_features, see, see_both, see_depth, taken_apart
from thermosplat.gaussians import Gaussians
from thermosplat.initial_gaussians import initial_gaussians
from thermosplat.packed_parameters import num_bytes, pack, unpack
from thermosplat.rendered_frame import RenderedFrame
from thermosplat.spectrum_decoders import SpectrumDecoders, make_decoders
from thermosplat.view_directions import view_directions
from thermosplat.warp_covered_images import warp_covered

if TYPE_CHECKING:
    from thermosplat.datasets.capture import Capture
    from thermosplat.datasets.frame_tensors import ViewTensors

__all__ = ["RenderedFrame", "SceneModel"]


class SceneModel(nn.Module):
    """Gaussians and decoders of one scene.

    Attributes:
        gaussian_sets: The sets by name: "shared", or "rgb" and/or "thermal".
        decoders: The pixel-wise networks; None where the Gaussians have no features.
        background: Colour behind the Gaussians in the RGB image, shape [3].

    Args:
        config: What is modelled, and how.
        decoder: Widths and switches of the decoders.
        gaussian_sets: The Gaussians by set name, as ``config.gaussian_sets`` asks for.
        thermal_channels: 3 for pseudo-coloured thermal images, 1 for normalised radiometric ones, 0 for none.
        background: RGB background colour in [0, 1].
    """

    background: Tensor

    def __init__(
        self,
        config: ModelConfig,
        decoder: DecoderConfig,
        gaussian_sets: dict[str, Gaussians],
        thermal_channels: int,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        super().__init__()
        self.config = config
        self.decoder_config = decoder
        self.thermal_channels = thermal_channels if config.thermal else 0
        self.gaussian_sets = nn.ModuleDict(gaussian_sets)
        self.decoders: Decoders | SpectrumDecoders | None = None
        if config.gaussian_sets == "shared" and config.feature_dim > 0:
            self.decoders = make_decoders(decoder, config.feature_dim, self.thermal_channels)
        self.register_buffer("background", torch.tensor(background, dtype=torch.float32), persistent=False)
        self._has_background = any(channel != 0.0 for channel in background)

    def gaussians(self, name: str) -> Gaussians:
        """The set of Gaussians of that name.

        Args:
            name: "shared", "rgb" or "thermal".

        Raises:
            KeyError: The model has no such set.
        """
        gaussians = self.gaussian_sets[name]
        if not isinstance(gaussians, Gaussians):
            raise TypeError(f"gaussian_sets[{name!r}] is {type(gaussians).__name__}, not Gaussians.")
        return gaussians

    @property
    def num_gaussians(self) -> int:
        """Gaussians in all sets together."""
        return sum(len(self.gaussians(name)) for name in self.gaussian_sets)

    @property
    def num_bytes(self) -> int:
        """Bytes of all parameters as a checkpoint stores them: without zeros of SH bands and thermal offsets."""
        stored = self.checkpoint_state()
        return sum(num_bytes(values) for values in [*stored["gaussian_sets"].values(), stored["decoders"] or {}])

    @property
    def feature_channels(self) -> int | None:
        """Latent channels that are blended; None where there are no features."""
        return self.gaussians("shared").features.shape[1] if self.decoders is not None else None

    @property
    def offsets_kept(self) -> float | None:
        """Share of the Gaussians with a thermal opacity of their own; None where there are no offsets."""
        offsets = [value for name, value in self.named_parameters() if name.endswith("thermal_opacity_offsets")]
        return (offsets[0] != 0).float().mean().item() if offsets else None

    # ---- rendering ---------------------------------------------------------------------------------------------------

    def render(
        self,
        rgb: "ViewTensors | None",
        thermal: "ViewTensors | None",
        *,
        sh_degree: int,
        absgrad: bool = False,
        aligned: bool | None = None,
        deterministic: bool = False,
        depth_spread_limit: float | None = None,
    ) -> RenderedFrame:
        """Render one frame: both spectra, or the one whose view is given.

        A shared set renders two views of one camera in a single traversal, two different cameras by one call each.

        Args:
            rgb: Camera of the RGB image; None: do not render it.
            thermal: Camera of the thermal image; None: do not render it.
            sh_degree: Highest degree of the spherical harmonics to use now.
            absgrad: Also accumulate absolute means2d gradients (``info["means2d"].absgrad``).
            aligned: Whether both views have one camera, pose and size. None: compare them. False is always right, and
                keeps the spectra's gradients of means2d apart.
            deterministic: As the rasterizer's.
            depth_spread_limit: Also measure how far depths spread along rays, counting hardly more than this
                (``LossConfig.depth_spread_limit``); None: do not. A model without features never does.

        Returns:
            The images; a spectrum that the configuration switches off is not rendered even if its view is given.
        """
        rgb = rgb if self.config.rgb else None
        thermal = thermal if self.config.thermal else None
        backgrounds = self.background[None] if self._has_background else None
        how = Rendering(sh_degree, absgrad, self.config.rasterize_mode, backgrounds, deterministic, depth_spread_limit)
        common = self._common_view(rgb, thermal, aligned)
        if self.decoders is None:
            return self._render_sh(rgb, thermal, how) if common is None else self._render_sh_traversal(common, how)
        if common is not None:
            return self._render_traversal(self.decoders, common, True, how)
        rendered = RenderedFrame(infos={"shared": []})
        if rgb is not None:
            rendered = self._render_traversal(self.decoders, rgb, False, how)
            rendered.infos["shared"][0]["modality"] = "rgb"
        if thermal is not None:
            gaussians = self.gaussians("shared")
            blended = blended_features(gaussians, thermal, how)
            image, alpha, info = see(gaussians, blended, gaussians.thermal_logits, thermal, how)
            features, spreads = taken_apart(gaussians, image, alpha, how)
            decoded = self.decoders.thermal(*self.decoder_inputs(thermal, features))
            rendered.thermal, rendered.thermal_alpha = self._covered(decoded, alpha), alpha
            rendered.thermal_features = features
            rendered.depth_spreads += spreads
            info["modality"] = "thermal"
            rendered.infos["shared"].append(info)
        return rendered

    def render_depth(self, modality: Literal["rgb", "thermal"], view: "ViewTensors") -> Tensor:
        """What a spectrum sees as far away: expected depth along z [world units], [H, W]; 0 where it sees nothing.

        Args:
            modality: "rgb" weighs the Gaussians with α, "thermal" with α_t; with separate sets, its own set.
            view: Camera and pose.
        """
        gaussians = self.gaussians(modality if modality in self.gaussian_sets else "shared")
        logits = gaussians.logit_opacities if modality == "rgb" else gaussians.thermal_logits
        how = Rendering(0, False, self.config.rasterize_mode, None)
        return see_depth(gaussians, logits, view, how)

    def _common_view(
        self, rgb: "ViewTensors | None", thermal: "ViewTensors | None", aligned: bool | None
    ) -> "ViewTensors | None":
        """The camera from which one traversal renders both spectra; None where they need a call each."""
        if rgb is None or thermal is None or "shared" not in self.gaussian_sets:
            return None
        return rgb if (_same_camera(rgb, thermal) if aligned is None else aligned) else None

    def _render_traversal(
        self, decoders: Decoders | SpectrumDecoders, view: "ViewTensors", with_thermal: bool, how: Rendering
    ) -> RenderedFrame:
        """SH colours and features at α, and with them the features at α_t where asked, in one traversal."""
        gaussians = self.gaussians("shared")
        blended = blended_features(gaussians, view, how)
        output = see_both(gaussians, with_thermal and gaussians.has_two_opacities, blended, view, how)
        # squeeze, not [0], whose gradient would be copied into zeros
        alpha = output.render_alphas.squeeze(0)
        visible_features, spreads = taken_apart(gaussians, output.render_features.squeeze(0), alpha, how)
        rendered = RenderedFrame(visible_features=visible_features, rgb_alpha=alpha, depth_spreads=spreads)
        rendered.infos["shared"] = [output.info]
        if with_thermal:
            thermal_alpha, thermal_features = alpha, visible_features  # of one opacity both spectra see the same
            if output.render_thermal_features is not None and output.render_thermal_alphas is not None:
                thermal_alpha = output.render_thermal_alphas.squeeze(0)
                blended_thermal = output.render_thermal_features.squeeze(0)
                thermal_features, spreads = taken_apart(gaussians, blended_thermal, thermal_alpha, how)
            rendered.thermal_alpha, rendered.thermal_features = thermal_alpha, thermal_features
            rendered.depth_spreads = rendered.depth_spreads + spreads
            decoded, thermal = decoders.both(*self.decoder_inputs(view, visible_features, thermal_features))
            rendered.thermal = self._covered(thermal, thermal_alpha)
        else:
            decoded = decoders.rgb(*self.decoder_inputs(view, visible_features))
        if self.decoder_config.hybrid_rgb:
            rendered.rgb = self._covered(decoded, alpha, output.render_colors.squeeze(0))
        elif self.decoder_config.covered_only:
            rendered.rgb = self._covered(decoded, alpha, (1.0 - alpha) * self.background)
        else:
            rendered.rgb = decoded
        return rendered

    def _covered(self, decoded: Tensor, alpha: Tensor, base: Tensor | None = None) -> Tensor:
        """A decoded image as far as Gaussians cover it, added to ``base``, or black, the coldest temperature."""
        if not self.decoder_config.covered_only:
            return decoded if base is None else base + decoded
        if decoded.is_cuda:
            return warp_covered(decoded, alpha, base)
        covered = alpha * decoded
        return covered if base is None else base + covered

    def decoder_inputs(self, view: "ViewTensors", *features: Tensor) -> tuple[Tensor, ...]:
        """Rendered features [H, W, d] as the decoders take them: with the viewing directions, where they see those."""
        if not self.decoder_config.view_direction:
            return features
        directions = view_directions(view)
        return tuple(torch.cat([image, directions], dim=-1) for image in features)

    def _render_sh_traversal(self, view: "ViewTensors", how: Rendering) -> RenderedFrame:
        """Both spectra from the spherical harmonics of one set, in one traversal."""
        gaussians = self.gaussians("shared")
        output = see_both(gaussians, self.config.geometric_decoupling, gaussians.thermal_sh_coeffs, view, how)
        thermal, alphas = output.render_thermal_features, output.render_thermal_alphas
        if thermal is None or alphas is None:
            thermal, alphas = output.render_features, output.render_alphas
        return RenderedFrame(
            rgb=output.render_colors.squeeze(0),
            thermal=self._thermal_image(thermal.squeeze(0)),
            rgb_alpha=output.render_alphas.squeeze(0),
            thermal_alpha=alphas.squeeze(0),
            infos={"shared": [output.info]},
        )

    def _render_sh(self, rgb: "ViewTensors | None", thermal: "ViewTensors | None", how: Rendering) -> RenderedFrame:
        """Each spectrum by a call of its own from its spherical harmonics, as 3DGS."""
        rendered = RenderedFrame()
        if rgb is not None:
            name = "rgb" if "rgb" in self.gaussian_sets else "shared"
            gaussians = self.gaussians(name)
            rendered.rgb, rendered.rgb_alpha, info = see(
                gaussians, gaussians.sh_coeffs, gaussians.logit_opacities, rgb, how, backgrounds=how.backgrounds
            )
            info["modality"] = "rgb"
            rendered.infos[name] = [info]
        if thermal is not None:
            name = "thermal" if "thermal" in self.gaussian_sets else "shared"
            gaussians = self.gaussians(name)
            colors, rendered.thermal_alpha, info = see(
                gaussians, gaussians.thermal_sh_coeffs, gaussians.thermal_logits, thermal, how
            )
            rendered.thermal = self._thermal_image(colors)
            info["modality"] = "thermal"
            rendered.infos.setdefault(name, []).append(info)
        return rendered

    def _thermal_image(self, colors: Tensor) -> Tensor:
        """The thermal image [H, W, thermal channels] of blended thermal SH colours [H, W, 3].

        A one-channel image is the mean of three channels that start equal and get equal gradients: they stay grey, and
        so does the exported PLY.
        """
        return colors if self.thermal_channels == 3 else colors.mean(dim=-1, keepdim=True)

    # ---- making and restoring ----------------------------------------------------------------------------------------

    @classmethod
    def from_capture(cls, config: TrainConfig, capture: "Capture", device: torch.device | str) -> "SceneModel":
        """A model at the start of training; the same for the same seed, whatever was drawn before.

        Args:
            config: The whole configuration: model, decoders, SH degree, background and seed.
            capture: The capture, for its sparse points and for what its thermal images are.
            device: Where the model shall live.

        Raises:
            UserError: If the configuration contradicts itself, or the capture lacks images of a spectrum that is to be
                modelled, or points to start from.
        """
        check_config(config)
        gaussian_sets = initial_gaussians(config, capture)
        thermal_channels = capture.thermal_scale.channels if capture.thermal_scale is not None else 0
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            model = cls(config.model, config.decoder, gaussian_sets, thermal_channels, config.background)
        return model.to(device)

    def checkpoint_state(self) -> dict[str, Any]:
        """What ``from_checkpoint`` needs under the checkpoint's key "model"."""
        return {
            "gaussian_sets": {name: pack(self.gaussians(name).state_dict()) for name in self.gaussian_sets},
            "decoders": self.decoders.state_dict() if self.decoders is not None else None,
            "thermal_channels": self.thermal_channels,
        }

    @classmethod
    def from_checkpoint(cls, state: dict[str, Any], device: torch.device | str) -> "SceneModel":
        """The model of a checkpoint.

        Args:
            state: The checkpoint: its "config" (plain) and its "model" (``checkpoint_state``).
            device: Where the model shall live.

        Raises:
            UserError: It is incomplete.
        """
        config = from_dict(state["config"])
        saved = state["model"]
        num_bases = (config.sh_degree + 1) ** 2 - 1
        with damage_explained("model"):
            gaussian_sets = {
                name: Gaussians.from_state_dict(unpack(values, num_bases))
                for name, values in saved["gaussian_sets"].items()
            }
            model = cls(config.model, config.decoder, gaussian_sets, saved["thermal_channels"], config.background)
            if model.decoders is not None:
                model.decoders.load_state_dict(saved["decoders"])
        return model.to(device)


def _same_camera(rgb: "ViewTensors", thermal: "ViewTensors") -> bool:
    """Whether two views have one camera, pose and size."""
    return (
        (rgb.width, rgb.height) == (thermal.width, thermal.height)
        and torch.equal(rgb.K, thermal.K)
        and torch.equal(rgb.viewmat, thermal.viewmat)
    )
