"""What each date of the block of houses has: weather, and what changed since the first."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Date:
    """One date of the block."""

    air: float
    """Temperature of the air [deg C]."""
    unset: float
    """Temperature of what has none of its own [deg C]."""
    sky: tuple[float, float]
    """Apparent temperatures at the zenith and at the horizon [deg C]."""
    sun: tuple[tuple[float, float, float], tuple[float, float, float]]
    """Direction in which it shines, and its radiance."""
    leak: tuple[float, float]
    """Standard deviation as a share of the ground's sides, and excess [K]."""
    cars: tuple[float, float] = (0.0, 0.0)
    """How far to the east the cars with even and with odd numbers stand of their first places [m]."""
    insulated: tuple[int, ...] = ()
    """Houses whose roofs were insulated."""
    repaired: tuple[int, ...] = ()
    """Houses whose hot cell was repaired."""
    wet: tuple[tuple[float, float, float, float], ...] = ((0.3, 0.6, 0.09, 2.6),)
    """Spots of wet insulation in the flat roof: place and standard deviation as shares of its sides, excess [K]."""


DATES = (
    Date(
        air=13.0,
        unset=15.0,
        sky=(-24, 6),
        sun=((0.42, 0.5, -0.76), (5.0, 4.8, 4.3)),
        leak=(0.018, 4.5),
    ),
    Date(
        air=7.0,
        unset=11.0,
        sky=(-30, 2),
        sun=((-0.5, 0.42, -0.75), (4.2, 4.1, 3.9)),
        leak=(0.030, 7.5),
        cars=(-7, 9),
        insulated=(1,),
        repaired=(2,),
    ),
    Date(
        air=10.0,
        unset=13.0,
        sky=(-18, 5),
        sun=((0.1, 0.62, -0.78), (4.6, 4.4, 4.0)),
        leak=(0.040, 9.5),
        cars=(6, -8),
        insulated=(1,),
        repaired=(2,),
        wet=((0.3, 0.6, 0.09, 2.6), (0.28, 0.22, 0.07, 2.2)),
    ),
)
"""A week lies between two dates."""
