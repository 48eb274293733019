"""Temperatures as the flags --emissivity, --reflected, --air, --humidity, --window and --labels ask for them."""

from typing import TYPE_CHECKING

from thermosplat.config.temperature_settings import LEAST_EMISSIVITY, TemperatureSettings
from thermosplat.errors import UserError

if TYPE_CHECKING:
    from thermosplat.datasets.capture import Capture
    from thermosplat.evaluation.loaded_run import LoadedRun
    from thermosplat.thermography.scene_temperatures import SceneTemperatures


def asked_temperatures(
    settings: TemperatureSettings, loaded: "LoadedRun", capture: "Capture | None"
) -> "SceneTemperatures":
    """How the temperatures of a run are made; says what is to be known of it.

    Args:
        capture: Its capture; None: it is not at hand.

    Raises:
        UserError: As ``LoadedRun.temperatures``; or nothing would be recalculated at all.
    """
    if settings.emissivity is not None and settings.emissivity < LEAST_EMISSIVITY and settings.labels is None:
        settings.checked()
        raise UserError(
            f"With an emissivity of {settings.emissivity:g} most of what the camera sees is reflected. Below "
            f"{LEAST_EMISSIVITY:g} no temperature is recalculated.",
            "Give single surfaces theirs with --labels, and leave what mirrors out.",
        )
    if not settings.any_given:
        return loaded.temperatures()
    made = loaded.temperatures(settings, capture=capture, metres_per_unit=known_scale(capture))
    if made.text:
        print(f"Temperatures are {made.text}.")
    for note in made.notes:
        print(note)
    return made


def known_scale(capture: "Capture | None") -> float | None:
    """Length of a world unit of a capture [m]: 1 with a calibrated rig, else by GPS; None: nobody knows."""
    from thermosplat.export.maps.georeference import georeferenced_frame

    if capture is None:
        return None
    if (capture.root / "calibration.json").is_file():  # thermosplat-prepare register: lengths are in metres
        return 1.0
    leading = next((name for name in capture.spectra if any(name in frame.views for frame in capture.train)), None)
    try:
        frame = None if leading is None else georeferenced_frame(capture, leading)
    except UserError as error:  # such as rasterio that is missing
        print(f"GPS gives no scale: {error.message} {error.hint}".rstrip())
        return None
    return None if frame is None else frame.scale / capture.placement.unit
