"""Settings of movers: how many people, vehicles and drones a world has, and how they move.

Reading a dataset imports this file, so it imports no numerical code."""

from dataclasses import dataclass

from lidarsim.parameters import Checked, number

VERSION = 1
"""Raised whenever the same settings and seed give other movers, with the reason in the log."""
# new kinds go to the end: datasets hold the numbers of those that are there
KINDS = ("person", "vehicle", "drone")
"""Kinds of movers; samples store the number of a kind, from 1 on."""
MAX_MOVERS = 24
"""Most movers of a world: the tables of samples have a row for each."""
MAX_SOLIDS = 3
"""Most solids of a mover."""
MAX_PIECES = 32
"""Most pieces of a course that a sample stores, see `before_s` and `after_s`."""
# a power of two: times from 0 on are brought into the period without rounding
PERIOD_S = 32.0
"""Every course repeats after this time, seconds."""


@dataclass(frozen=True, kw_only=True)
class Traffic(Checked):
    """A recipe's [movers]: what moves in its worlds. Worlds without room for the least numbers are
    drawn again. Counts and speeds are drawn evenly from between two bounds, both included."""

    people: tuple[int, int] = number((2, 4), minimum=0, maximum=MAX_MOVERS, rising=True)
    """People of a world: upright capsules, where the kind has people."""
    # none is asked for: between parked cars, nearly half of the streets have no room
    vehicles: tuple[int, int] = number((0, 2), minimum=0, maximum=MAX_MOVERS, rising=True)
    """Vehicles: a box with a cabin, where the kind has vehicles."""
    drones: tuple[int, int] = number((1, 2), minimum=0, maximum=MAX_MOVERS, rising=True)
    """Drones: flat ellipsoids."""
    person_mps: tuple[float, float] = number((0.6, 1.7), above=0, maximum=4, rising=True)
    """Speed of people, metres a second. Source: comfortable to brisk walking (Bohannon,
    "Comfortable and maximum walking speed of adults aged 20-79 years", 1997)."""
    vehicle_mps: tuple[float, float] = number((2.0, 8.0), above=0, maximum=15, rising=True)
    """Speed of vehicles, metres a second. Source: up to 30 km/h, the limit of residential
    streets."""
    drone_mps: tuple[float, float] = number((0.5, 3.0), above=0, maximum=15, rising=True)
    """Speed of drones, metres a second."""
    person_mps2: float = number(1.0, above=0, maximum=10)
    """Maximum acceleration of people, m/s². Source: half of what a relaxation time of 0.5 s gives
    (Helbing and Molnár, "Social force model for pedestrian dynamics", 1995)."""
    vehicle_mps2: float = number(2.0, above=0, maximum=10)
    """Maximum acceleration of vehicles, m/s². Source: below the 3.4 m/s² of a comfortable stop
    (AASHTO, "A Policy on Geometric Design of Highways and Streets")."""
    drone_mps2: float = number(3.0, above=0, maximum=20)
    """Maximum acceleration of drones, m/s²."""
    turn_rad_s: float = number(1.5, above=0, maximum=10)
    """Maximum mean rate of a turn, radians a second; in its middle, at most twice that."""
    sensor_mps: float = number(1.0, above=0, maximum=30)
    """Speed of the sensor, which times the viewpoints of a flight, metres a second."""
    # off: the paper's sensor casts all rays at once, so recipes with it would be refused
    firing_times: bool = False
    """Whether each ray meets movers where they are at its own time, not when the scan begins."""
    after_s: float = number(2.5, minimum=0, maximum=10)
    """Seconds after a sample's time for which courses are stored."""

    def __post_init__(self) -> None:
        super().__post_init__()
        most = self.people[1] + self.vehicles[1] + self.drones[1]
        if most > MAX_MOVERS:
            raise ValueError(
                f"people, vehicles and drones: up to {most} movers, expected {MAX_MOVERS} at most"
            )

    def counts(self, kind: str) -> tuple[int, int]:
        """Bounds of the number of movers of a kind."""
        return {"person": self.people, "vehicle": self.vehicles, "drone": self.drones}[kind]


PRESETS = {
    "light": Traffic(),
    "medium": Traffic(people=(4, 6), drones=(2, 4)),
    "dense": Traffic(people=(6, 10), vehicles=(1, 3), drones=(4, 6)),
}
"""The settings by the value of --movers."""
