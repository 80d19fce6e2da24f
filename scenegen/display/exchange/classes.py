"""The numbers of classes in SemanticKITTI and Occ3D-nuScenes, by scenegen's names and by theirs."""


def _numbers(lines: str) -> dict[str, int]:
    """A table of lines, each a number and the names of the classes that have it."""
    table = [line.split() for line in lines.strip().splitlines()]
    return {name: int(number) for number, *names in table for name in names}


# numbers that its table of classes maps to empty are left out: other-structure, other-object
SEMANTIC_KITTI = _numbers("""
10 car vehicle tyre
11 bicycle
13 bus
15 motorcycle
18 truck
20 other_vehicle
30 person
31 bicyclist
32 motorcyclist
40 road
44 parking
48 sidewalk
49 other_ground floor
50 building wall ceiling roof door column stairs beam
51 fence
60 lane_marking
70 vegetation
71 trunk
72 terrain
80 pole
81 traffic_sign sign
""")
"""As in `config/semantic-kitti.yaml` of github.com/PRBonn/semantic-kitti-api."""
OCC3D = _numbers("""
0 others other rock
1 barrier
2 bicycle
3 bus
4 car vehicle tyre
5 construction_vehicle
6 motorcycle
7 pedestrian person
8 traffic_cone
9 trailer
10 truck
11 driveable_surface road
12 other_flat floor
13 sidewalk
14 terrain
15 manmade building wall ceiling roof door column stairs beam pole sign fence
15 furniture shelf goods cable pipe tank machine
16 vegetation trunk
""")
"""As Occ3D-nuScenes numbers the classes of nuScenes' lidarseg; 17 is free."""
