"""Camera paths: where they go, what they look at, and that they are rigid motions."""

import numpy as np
import pytest

from thermosplat.errors import UserError
from thermosplat.novel_views.camera_paths import ellipse_path, focus_point, interpolated_path, look_to, spiral_path

UP = np.array([0.0, -1.0, 0.0])  # OpenCV worlds hang down


def ring(count: int = 12, target: tuple[float, float, float] = (0.5, 0.2, -0.3)) -> np.ndarray:
    """Cameras on an ellipse with half axes 3 and 2 at height -1, all looking at a target."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    middle = np.array([target[0], 0.0, target[2]])
    centres = [middle + np.array([3 * np.cos(angle), -1.0, 2 * np.sin(angle)]) for angle in angles]
    return np.stack([look_to(centre, np.array(target) - centre, UP) for centre in centres])


def wall(count: int = 9) -> np.ndarray:
    """Cameras side by side before a wall, all looking along +z."""
    grid = [(x, y) for x in np.linspace(-1, 1, count) for y in (-0.4, 0.4)]
    return np.stack([look_to(np.array([x, y, 0.1 * x]), np.array([0.0, 0.0, 1.0]), UP) for x, y in grid])


def centres(viewmats: np.ndarray) -> np.ndarray:
    return np.linalg.inv(viewmats)[:, :3, 3]


@pytest.mark.parametrize("path", [interpolated_path, ellipse_path, spiral_path])
@pytest.mark.parametrize("cameras", [ring(), wall()], ids=["ring", "wall"])
def test_poses_are_rigid_and_upright(path, cameras: np.ndarray) -> None:
    """Every pose of every path is a rotation and a shift, and the cameras do not tip over."""
    poses = path(cameras, 17)
    assert poses.shape == (17, 4, 4)
    rotations = poses[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (17, 3, 3)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)
    assert (-rotations[:, 1] @ UP > 0).all()


def test_look_to_axes() -> None:
    """A camera looks where it is told: the target is on +z, what is above it has negative y."""
    viewmat = look_to(np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, 2.0]), UP)
    np.testing.assert_allclose(viewmat @ [1.0, 2.0, 8.0, 1.0], [0, 0, 5, 1])
    assert (viewmat @ [1.0, 1.0, 8.0, 1.0])[1] < 0
    assert (viewmat @ [2.0, 2.0, 8.0, 1.0])[0] > 0


def test_look_straight_up_is_a_rotation() -> None:
    """A viewing direction along "up" still gives a rotation."""
    rotation = look_to(np.zeros(3), UP, UP)[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_focus_point_is_where_the_axes_meet() -> None:
    """All cameras of the ring look at one point."""
    np.testing.assert_allclose(focus_point(np.linalg.inv(ring())), [0.5, 0.2, -0.3], atol=1e-9)


def test_interpolation_passes_through_the_views() -> None:
    """The path starts and ends at the given poses, passes those between, and moves at constant speed."""
    views = ring(5)
    poses = interpolated_path(views, 2001)
    np.testing.assert_allclose(poses[[0, -1]], views[[0, -1]], atol=1e-9)
    for view in views:
        assert np.linalg.norm(centres(poses) - centres(view[None]), axis=1).min() < 0.01
    steps = np.linalg.norm(np.diff(centres(poses), axis=0), axis=1)
    assert steps.max() < 1.15 * steps.min()  # chords of the ellipse differ by half


def test_interpolation_of_a_camera_that_only_turns() -> None:
    """Without movement the path runs through the directions."""
    views = np.stack([look_to(np.zeros(3), np.array([np.sin(a), 0, np.cos(a)]), UP) for a in (0.0, 0.4, 0.8)])
    poses = interpolated_path(views, 9)
    np.testing.assert_allclose(poses[[0, 4, 8]], views, atol=1e-9)


def test_ellipse_looks_at_the_focus_from_among_the_cameras() -> None:
    """Every pose has the focus on its axis; the ellipse has the cameras' height and about their radii."""
    poses = ellipse_path(ring(60), 40)
    seen = poses @ np.array([0.5, 0.2, -0.3, 1.0])
    np.testing.assert_allclose(seen[:, :2], 0, atol=1e-9)
    assert (seen[:, 2] > 0).all()
    np.testing.assert_allclose(centres(poses)[:, 1], -1.0, atol=1e-9)
    spread = np.abs(centres(poses) - [0.5, 0, -0.3]).max(axis=0)
    np.testing.assert_allclose(spread[[0, 2]], [3, 2], rtol=0.1)


def orbit(*angles: float, radius: float = 3.0, height: float = 1.0, jitter: float = 0.0) -> np.ndarray:
    """Cameras round a point at these angles [°], held by hand where there is jitter."""
    chance = np.random.default_rng(3)
    centres = [
        [radius * np.cos(a), -height, radius * np.sin(a)] + jitter * chance.normal(size=3) for a in np.radians(angles)
    ]
    return np.stack([look_to(np.array(c), jitter * chance.normal(size=3) - c, UP) for c in centres])


def dome() -> np.ndarray:
    """Cameras all over half a sphere."""
    angles = np.linspace(0, 350, 18)
    return np.concatenate([orbit(*angles, radius=3 * np.cos(e), height=3 * np.sin(e)) for e in (0.1, 0.5, 0.9, 1.3)])


def drone() -> np.ndarray:
    """Cameras in strips that look straight down, nearly."""
    chance = np.random.default_rng(3)
    places = [np.array([x, -5.0, z]) for x in np.linspace(-4, 4, 9) for z in np.linspace(-3, 3, 7)]
    north = np.array([0.0, 0.0, 1.0])
    return np.stack([look_to(place, -UP + 0.03 * chance.normal(size=3), north) for place in places])


def room() -> np.ndarray:
    """Cameras in the middle of a room that look at its walls."""
    ways = [np.array([np.cos(a), 0.0, np.sin(a)]) for a in np.linspace(0, 6, 20)]
    return np.stack([look_to(0.5 * way, way, UP) for way in ways])


def road() -> np.ndarray:
    """Cameras in one line that look ahead."""
    return np.stack(
        [look_to(np.array([0.05 * np.sin(i), 0.0, i / 4]), -np.cross(UP, [1.0, 0, 0]), UP) for i in range(40)]
    )


@pytest.mark.parametrize(
    ("cameras", "distance", "degrees"),
    [
        (orbit(*np.linspace(20, 140, 20)), 0.2, 5),
        (orbit(*np.linspace(20, 140, 40), jitter=0.1), 0.4, 20),
        (orbit(*np.linspace(20, 140, 20), height=3.0), 0.3, 5),
        (orbit(0, 60, 120), 1.6, 30),
        (orbit(*np.linspace(300, 420, 20)), 0.2, 5),
        (orbit(*np.linspace(20, 320, 40)), 0.3, 5),
        (orbit(*np.linspace(0, 50, 12), *np.linspace(180, 230, 20)), 0.3, 5),
        (np.concatenate([orbit(*np.linspace(20, 140, 20)), orbit(50, radius=40)]), 0.9, 8),
        (orbit(*np.linspace(0, 345, 24)), 0.4, 8),
        (dome(), 0.9, 20),
        (drone(), 0.8, 8),
        (room(), 0.2, 10),
        (road(), 0.2, 2),
    ],
    ids=[
        "arc",
        "jitter",
        "from-above",
        "three",
        "over-0",
        "most",
        "two-arcs",
        "outlier",
        "ring",
        "dome",
        "drone",
        "room",
        "road",
    ],
)
def test_ellipse_stays_where_cameras_were(cameras: np.ndarray, distance: float, degrees: float) -> None:
    """Every pose is near a camera and looks about where that one looked; it moves, smoothly, and closes."""
    poses, given = np.linalg.inv(ellipse_path(cameras, 60)), np.linalg.inv(cameras)
    apart = np.linalg.norm(poses[:, None, :3, 3] - given[:, :3, 3], axis=-1)
    assert apart.min(axis=1).max() < distance
    cosines = np.einsum("fi,fi->f", poses[:, :3, 2], given[apart.argmin(axis=1), :3, 2])
    assert cosines.min() > np.cos(np.radians(degrees))
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0, append=poses[:1, :3, 3]), axis=1)
    assert steps.sum() > 1.5
    assert steps.max() < 0.12 * steps.sum()


def test_ellipse_goes_along_all_of_an_arc() -> None:
    """From its first camera to its last one and back."""
    places = centres(ellipse_path(orbit(*np.linspace(20, 140, 20)), 60))
    angles = np.degrees(np.arctan2(places[:, 2], places[:, 0]))
    np.testing.assert_allclose([angles.min(), angles.max()], [20, 140], atol=1)


def test_spiral_stays_before_the_wall() -> None:
    """The spiral keeps within the cameras' reach and looks towards the wall."""
    poses = spiral_path(wall(), 30)
    assert (np.abs(centres(poses)) <= [1.01, 0.41, 0.11]).all()
    assert (poses[:, 2, 2] > 0.5).all()
    assert np.ptp(centres(poses)[:, 0]) > 1


def test_spiral_looks_at_the_focus() -> None:
    """Where the cameras look at one point, every pose of the spiral does."""
    seen = spiral_path(ring(), 20) @ np.array([0.5, 0.2, -0.3, 1.0])
    np.testing.assert_allclose(seen[:, :2], 0, atol=1e-9)
    assert (seen[:, 2] > 0).all()


def test_spiral_of_a_drive_looks_ahead() -> None:
    """Cameras that were driven along their parallel axes see the road from every pose, the foremost one too."""
    places = np.stack([0.05 * np.sin(np.arange(40)), 0.02 * np.cos(np.arange(40)), np.linspace(0, 10, 40)], axis=1)
    drive = np.stack([look_to(place, np.array([0.0, 0.0, 1.0]), UP) for place in places])
    poses = spiral_path(drive, 120)
    assert np.ptp(centres(poses)[:, 2]) > 5
    assert (poses[:, 2, 2] > np.cos(np.radians(45))).all()


@pytest.mark.parametrize("path", [interpolated_path, ellipse_path, spiral_path])
def test_paths_of_a_camera_that_stays_in_its_place(path) -> None:
    """Turned by half a circle, or not at all: every pose is a rotation all the same."""
    for directions in ([1.0, -1.0, 1.0, -1.0], [1.0, 1.0, 1.0, 1.0]):
        cameras = np.stack([look_to(np.zeros(3), np.array([0.0, 0.0, z]), UP) for z in directions])
        poses = path(cameras, 7)
        np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0)


@pytest.mark.parametrize(("path", "count"), [(interpolated_path, 1), (spiral_path, 1), (ellipse_path, 2)])
def test_too_few_views(path, count: int) -> None:
    """A path through too few views is refused with a path that works."""
    with pytest.raises(UserError, match=f"the capture has {count}") as caught:
        path(ring()[:count], 5)
    assert "--path train" in caught.value.hint
