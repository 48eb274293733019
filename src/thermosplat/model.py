"""The scene model: sets of Gaussians, decoders, and how a frame is rendered from them.

Two kinds of model, by ``ModelConfig.gaussian_sets``:

- "shared": one set for both spectra. The visible opacity α blends SH colours and features, the thermal opacity α_t
  blends the same features; decoders turn the features of each pixel into images (ThermoSplat). With ``feature_dim`` 0
  it models RGB alone, from its spherical harmonics, as plain 3DGS.
- "separate": one set a spectrum, each rendered from its spherical harmonics, without features (two independent 3DGS).
"""

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from thermosplat.config import DecoderConfig, ModelConfig, TrainConfig
from thermosplat.config_checks import check_config
from thermosplat.config_files import from_dict
from thermosplat.decoders import Decoders
from thermosplat.gaussians import Gaussians
from thermosplat.initial_gaussians import initial_gaussians
from thermosplat.rasterizer import rasterization, rasterization_rgbt
from thermosplat.rendered_frame import RenderedFrame

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
        self.decoders: Decoders | None = None
        if config.gaussian_sets == "shared" and config.feature_dim > 0:
            self.decoders = Decoders(decoder, config.feature_dim, self.thermal_channels)
        self.register_buffer("background", torch.tensor(background, dtype=torch.float32), persistent=False)
        self._has_background = any(channel != 0.0 for channel in background)

    def gaussians(self, name: str) -> Gaussians:
        """The set of Gaussians of that name.

        Args:
            name: "shared", "rgb" or "thermal".
        """
        gaussians = self.gaussian_sets[name]
        if not isinstance(gaussians, Gaussians):
            raise TypeError(f"gaussian_sets[{name!r}] is {type(gaussians).__name__}, not Gaussians.")
        return gaussians

    @property
    def num_gaussians(self) -> int:
        """Gaussians in all sets together."""
        return sum(len(self.gaussians(name)) for name in self.gaussian_sets)

    # ---- rendering ---------------------------------------------------------------------------------------------------

    def render(
        self,
        rgb: "ViewTensors | None",
        thermal: "ViewTensors | None",
        *,
        sh_degree: int,
        absgrad: bool = False,
        aligned: bool | None = None,
    ) -> RenderedFrame:
        """Render one frame: both spectra, or the one whose view is given.

        A shared set renders two views of one camera in a single traversal, two different cameras by one call each.

        Args:
            rgb: Camera of the RGB image; None: do not render it.
            thermal: Camera of the thermal image; None: do not render it.
            sh_degree: Highest degree of the spherical harmonics to use now.
            absgrad: Also accumulate absolute means2d gradients (``info["means2d"].absgrad``).
            aligned: Whether both views have one camera, pose and size. None: compare them.

        Returns:
            The images; a spectrum that the configuration switches off is not rendered even if its view is given.
        """
        rgb = rgb if self.config.rgb else None
        thermal = thermal if self.config.thermal else None
        if self.decoders is None:
            return self._render_sh(rgb, thermal, sh_degree, absgrad)
        if rgb is not None and thermal is not None and (_same_camera(rgb, thermal) if aligned is None else aligned):
            return self._render_traversal(self.decoders, rgb, True, sh_degree, absgrad)
        rendered = RenderedFrame(infos={"shared": []})
        if rgb is not None:
            visible = self._render_traversal(self.decoders, rgb, False, sh_degree, absgrad)
            rendered.rgb, rendered.rgb_alpha = visible.rgb, visible.rgb_alpha
            rendered.visible_features = visible.visible_features
            rendered.infos["shared"] += visible.infos["shared"]
        if thermal is not None:
            gaussians = self.gaussians("shared")
            features, alpha, info = self._rasterize(
                gaussians, gaussians.features, gaussians.thermal_opacities, thermal, None, absgrad
            )
            rendered.thermal, rendered.thermal_alpha = self._covered(self.decoders.thermal(features), alpha), alpha
            rendered.thermal_features = features
            rendered.infos["shared"].append(info)
        return rendered

    def _render_traversal(
        self, decoders: Decoders, view: "ViewTensors", with_thermal: bool, sh_degree: int, absgrad: bool
    ) -> RenderedFrame:
        """SH colours and features at α, and with them the features at α_t where asked, in one traversal."""
        gaussians = self.gaussians("shared")
        opacities = gaussians.opacities
        output = rasterization_rgbt(
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            opacities,
            gaussians.thermal_opacities if with_thermal else None,
            gaussians.sh_coeffs,
            gaussians.features,
            view.viewmat[None],
            view.K[None],
            view.width,
            view.height,
            sh_degree=sh_degree,
            backgrounds=self._backgrounds(),
            absgrad=absgrad,
            rasterize_mode=self.config.rasterize_mode,
        )
        visible_features = output.render_features[0]
        rendered = RenderedFrame(
            visible_features=visible_features, rgb_alpha=output.render_alphas[0], infos={"shared": [output.info]}
        )
        if with_thermal:
            rendered.thermal_features = output.render_thermal_features[0]
            rendered.thermal_alpha = output.render_thermal_alphas[0]
            decoded, thermal = decoders.both(visible_features, rendered.thermal_features)
            rendered.thermal = self._covered(thermal, rendered.thermal_alpha)
        else:
            decoded = decoders.rgb(visible_features)
        if self.decoder_config.hybrid_rgb:
            rendered.rgb = output.render_colors[0] + self._covered(decoded, output.render_alphas[0])
        else:
            rendered.rgb = self._covered(decoded, output.render_alphas[0], self.background)
        return rendered

    def _covered(self, decoded: Tensor, alpha: Tensor, behind: Tensor | None = None) -> Tensor:
        """A decoded image as far as Gaussians cover it; elsewhere ``behind``, or black, the coldest temperature."""
        if not self.decoder_config.covered_only:
            return decoded
        covered = alpha * decoded
        return covered if behind is None else covered + (1.0 - alpha) * behind

    def _render_sh(
        self, rgb: "ViewTensors | None", thermal: "ViewTensors | None", sh_degree: int, absgrad: bool
    ) -> RenderedFrame:
        """Each spectrum from the spherical harmonics of its own set, as 3DGS."""
        rendered = RenderedFrame()
        if rgb is not None:
            name = "rgb" if "rgb" in self.gaussian_sets else "shared"
            gaussians = self.gaussians(name)
            rendered.rgb, rendered.rgb_alpha, info = self._rasterize(
                gaussians,
                gaussians.sh_coeffs,
                gaussians.opacities,
                rgb,
                sh_degree,
                absgrad,
                self._backgrounds(),
            )
            rendered.infos[name] = [info]
        if thermal is not None:
            gaussians = self.gaussians("thermal")
            colors, rendered.thermal_alpha, info = self._rasterize(
                gaussians, gaussians.sh_coeffs, gaussians.opacities, thermal, sh_degree, absgrad
            )
            # A one-channel image is the mean of three channels that start equal and get equal gradients: they stay
            # grey, and so does the exported PLY.
            rendered.thermal = colors if self.thermal_channels == 3 else colors.mean(dim=-1, keepdim=True)
            rendered.infos["thermal"] = [info]
        return rendered

    def _rasterize(
        self,
        gaussians: Gaussians,
        colors: Tensor | tuple[Tensor, Tensor],
        opacities: Tensor,
        view: "ViewTensors",
        sh_degree: int | None,
        absgrad: bool,
        backgrounds: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """One view by one plain rasterization: image [H, W, X], accumulated opacity [H, W, 1], and its info."""
        image, alpha, info = rasterization(
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            opacities,
            colors,
            view.viewmat[None],
            view.K[None],
            view.width,
            view.height,
            sh_degree=sh_degree,
            packed=False,
            backgrounds=backgrounds,
            absgrad=absgrad,
            rasterize_mode=self.config.rasterize_mode,
        )
        return image[0], alpha[0], info

    def _backgrounds(self) -> Tensor | None:
        return self.background[None] if self._has_background else None

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
            "gaussian_sets": {name: self.gaussians(name).state_dict() for name in self.gaussian_sets},
            "decoders": self.decoders.state_dict() if self.decoders is not None else None,
            "thermal_channels": self.thermal_channels,
        }

    @classmethod
    def from_checkpoint(cls, state: dict[str, Any], device: torch.device | str) -> "SceneModel":
        """The model of a checkpoint.

        Args:
            state: The checkpoint: its "config" (plain) and its "model" (``checkpoint_state``).
            device: Where the model shall live.
        """
        config = from_dict(state["config"])
        saved = state["model"]
        gaussian_sets = {name: Gaussians.from_state_dict(values) for name, values in saved["gaussian_sets"].items()}
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
