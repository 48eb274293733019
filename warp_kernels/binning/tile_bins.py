"""The lists of Gaussians a tile, as binning leaves them to the blending, and the room that they may be given."""

from dataclasses import dataclass

import warp as wp


@dataclass(frozen=True)
class Room:
    """Room for lists whose lengths are not read back.

    Attributes:
        pairs: so many are listed at most.
        gaussians: so many of those with pairs are sorted at most.
        expected_pairs: pairs there may well be; decides how they are blended.
    """

    pairs: int
    gaussians: int
    expected_pairs: int


@dataclass
class TileBins:
    """Pairs sorted by image, tile and depth.

    Attributes:
        gaussian_ids: [num_pairs] flat (image, Gaussian) index of each sorted pair.
        masks: uint8 [num_pairs] parts of its tile that each sorted pair can reach, a bit each; empty on the CPU.
        tile_offsets: [images · tiles + 1] first sorted pair of each tile; the last entry is the number of pairs.
        order: [ranks] flat indices in depth order; those without tiles, or -1 in their place, are last or left out.
        pair_ends: int64 [ranks] end of each depth rank's range of unsorted pairs. The blending reads this and ``order``
            only with ``slots``.
        totals: the last entry holds the pairs and the Gaussians there are, room for them or not; None where
            ``pair_ends`` has all Gaussians.
        tiles_per_gaussian: [images · N] number of tiles.
        slots: [pairs] unsorted position of each sorted pair; None unless the adjoint writes one record per pair.
        num_pairs: number of pairs, or those there is room for; ``tile_offsets`` ends with the pairs there are.
        expected_pairs: number of pairs, or what was expected where there was room for so many.
        has_room: there was room, so that nothing is read back.
        tile_size: edge of a tile [px].
        tiles_x: tiles across the image.
        tiles_y: tiles down the image.
    """

    gaussian_ids: wp.array
    masks: wp.array
    tile_offsets: wp.array
    order: wp.array | None
    pair_ends: wp.array | None
    totals: wp.array | None
    tiles_per_gaussian: wp.array
    slots: wp.array | None
    num_pairs: int
    expected_pairs: int
    has_room: bool
    tile_size: int
    tiles_x: int
    tiles_y: int
