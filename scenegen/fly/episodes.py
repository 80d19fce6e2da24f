"""Recorded flights as episodes of a LeRobotDataset, for programs that learn from demonstrations."""

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from scenegen.errors import DatasetError, needs, raised_as
from scenegen.files import whole_folder
from scenegen.fly import EPISODES, PERIOD_S
from scenegen.fly.course import Course, Recording, flown_again
from scenegen.fly.loop import Flown
from scenegen.run import Counted, unheard

STATE = ("position", "quaternion", "velocity", "goal")
"""Parts of an observation that make `observation.state`, in order."""
NAMES = {
    "observation.state": "x y z qw qx qy qz vx vy vz goal_x goal_y goal_z",
    "action": "vx vy vz yaw_rate",
}
"""What the numbers of these are called."""


def write_episodes(recording: Recording, out: Path, on_flight: Counted = unheard) -> dict[str, int]:
    """Fly recorded flights again and write each as an episode, by LeRobot's own library.

    A frame is a tenth of a second. All its values are float32, or bool:

    - `observation.state` (13,): `STATE`, in the world, metres and m/s;
    - `observation.environment_state` (rays,): the sensor's ranges in the order of its rays, metres;
      its greatest range where nothing returned;
    - `action` (4,): the velocity, m/s, and the rate of yaw, rad/s, that were flown;
    - `next.reward`, as `Simulation.step` has it; `next.done`; and `next.success`, (1,) each.

    A flight that ended before its first action is left out. `on_flight` is called with 1 for each.

    Returns:
        How many `episodes` and `frames` were written.

    Raises:
        DatasetError: There is something at `out` already, LeRobot is not installed or refuses a
            frame, or a flight is not as it was recorded.
    """
    library = _library()
    data: Any = None
    with whole_folder(out) as folder, raised_as(DatasetError, f"{out}: "):
        folder.rmdir()  # LeRobot makes it
        for course, flights in recording.courses:
            for number, flown in enumerate(flights):
                frames = list(_frames(course, number, flown))
                if frames and data is None:
                    data = library.create(
                        f"scenegen/{out.name}",
                        fps=round(1 / PERIOD_S),
                        features=_features(frames[0]),
                        root=folder,
                        robot_type="quadrotor",
                        use_videos=False,
                    )
                task = f"fly through {Path(course.world).stem} to the goal"
                for frame in frames:
                    data.add_frame(frame | {"task": task})
                if frames:
                    data.save_episode()
                on_flight(1)
        if data is None:
            raise DatasetError("the recording holds no flight that began")
        data.finalize()
    return {"episodes": data.meta.total_episodes, "frames": data.meta.total_frames}


def _library() -> Any:
    """LeRobot's class of datasets, imported without what it says about videos, and with no bar of
    progress for each flight."""
    logging.getLogger("lerobot").setLevel(logging.ERROR)
    try:
        from datasets import disable_progress_bars
        from lerobot.datasets.lerobot_dataset import LeRobotDataset
    except ModuleNotFoundError:
        raise DatasetError(f"--to {EPISODES}: {needs('lerobot', EPISODES)}") from None
    disable_progress_bars()
    return LeRobotDataset


def _features(frame: dict[str, Any]) -> dict[str, Any]:
    """What LeRobot is told of a frame's values."""
    return {
        name: {
            "dtype": value.dtype.name,
            "shape": value.shape,
            "names": NAMES.get(name, "").split() or None,
        }
        for name, value in frame.items()
    }


def _frames(course: Course, number: int, flown: Flown) -> Iterator[dict[str, Any]]:
    """The frames of a flight, in order."""
    simulation, most_m = course.simulation(number), np.float32(course.sensor.max_range_m)
    last, success = len(flown.commands) - 1, flown.outcome == "success"
    for period, (seen, command, reward) in enumerate(flown_again(simulation, flown)):
        yield {
            "observation.state": np.concatenate([seen[name] for name in STATE], dtype=np.float32),
            # the far bound in place of infinity, so that means and deviations are finite
            "observation.environment_state": np.minimum(seen["ranges"].ravel(), most_m),
            "action": command,
            "next.reward": np.array([reward], np.float32),
            "next.done": np.array([period == last]),
            "next.success": np.array([period == last and success]),
        }
    if simulation.digest != flown.digest:
        raise DatasetError(f"{course.world}, flight {number}: is not as it was recorded; fly again")
