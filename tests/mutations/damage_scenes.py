"""Family ``scenes``: MJCF of numbers that are none, of sizes and depths beyond reason, of files
that are not there."""

import os
import re
import struct

from tests.mutations.case import words
from tests.mutations.damage_bytes import damage
from tests.mutations.generated import generated
from tests.mutations.nasty import ESCAPES
from tests.mutations.valid import SCENE

NUMBERS = """
nan inf -inf 1e308 -1e308 1e30 1e9 1e-300 0 -1 65536 2147483648 a
"""
NUMBERS = (*words(NUMBERS), "", "1 2 3 4 5 6 7")
DEEP = 20_000
ASSETS = """
<mesh name="m" file="missing.stl"/>
<mesh name="m" file="pipe"/>
<mesh name="m" file="/dev/zero"/>
<mesh name="m" file="liar.stl"/>
<mesh name="m" builtin="sphere" params="2000"/>
<mesh name="m" builtin="supersphere" params="20000 1 1"/>
<mesh name="m" vertex="nan 0 0 1 0 0 0 1 0 0 0 1"/>
<mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1" face="0 1 2000000000"/>
<hfield name="h" nrow="65536" ncol="65536" size="1 1 1 1"/>
<hfield name="h" nrow="4096" ncol="4096" size="1 1 1 1"/>
<hfield name="h" nrow="2" ncol="2" size="1 1 nan 1" elevation="0 nan 0 1"/>
<hfield name="h" file="liar.bin" size="1 1 1 1"/>
<texture name="t" type="2d" builtin="checker" width="60000" height="60000"/>
<texture name="t" type="2d" file="liar.png"/>
<model name="other" file="scene.xml"/>
<skin name="s" file="missing.skn"/>
"""
BODIES = """
<replicate count="1000000000" offset="1 0 0"><geom size="0.1"/></replicate>
<body><freejoint/><geom size="0.1" mass="nan"/></body>
<body><joint range="nan nan"/><geom size="0.1"/></body>
<composite type="cable" count="10000000 1 1" prefix="c" size="1"/>
<flexcomp type="grid" count="300 300 300" name="f" spacing="1 1 1"/>
<flexcomp type="grid" count="3 3 1" name="f" spacing="1 1 1" mass="1"/>
<include file="pipe"/>
<include file="missing.xml"/>
<include file="scene.xml"/>
<include file="/dev/zero"/>
<frame pos="nan 0 0"><geom size="0.1"/></frame>
<geom name="verify: all 17 checks passed&#10;scenegen: \x7f" size="-1"/>
<geom type="mesh" mesh="nobody"/>
<geom type="box" size="1e6 1e6 1e6"/>
<geom type="box" size="1e-12 1e-12 1e-12"/>
<plugin plugin="mujoco.nothing"/>
<light texture="x" bulbradius="nan"/><camera fovy="nan"/>
"""
SECTIONS = """
<size memory="100G"/>
<size memory="-1" njmax="2000000000" nconmax="2000000000"/>
<size nuserdata="2000000000" nkey="100000000"/>
<option timestep="nan" gravity="nan nan nan"/>
<compiler meshdir="/" settotalmass="nan" boundmass="nan"/>
<compiler settotalmass="10"/>
<extension><plugin plugin="mujoco.elasticity.cable"><instance name="x"/></plugin></extension>
<keyframe><key qpos="1 2 3"/></keyframe>
<statistic extent="nan" meansize="-1"/>
<custom><numeric name="n" size="2000000000" data="1"/></custom>
<custom><numeric name="flight_bounds" data="nan nan nan nan nan nan"/></custom>
<custom><numeric name="flight_bounds" data="-1e300 -1e300 -1e300 1e300 1e300 1e300"/></custom>
<visual><global offwidth='2000000000'/><map znear='nan'/></visual>
<what/>
"""
ADDED = {
    "asset": ASSETS.strip().splitlines(),
    "worldbody": (
        *BODIES.strip().splitlines(),
        '<replicate count="300">' * 3 + '<geom size="0.1"/>' + "</replicate>" * 3,
        '<geom size="0.1"/>' * 60_000,
        "<body>" * DEEP + '<geom size="0.1"/>' + "</body>" * DEEP,
        f'<geom name="{"n" * 100_000}" size="0.1"/>',
        '<geom user="' + "1 " * 100_000 + '" size="1"/>',
    ),
    "mujoco": (
        *SECTIONS.strip().splitlines(),
        "<worldbody/>" * 1000,
        "<!-- " + ESCAPES.replace("\x00", "") + " -->",
    ),
}
"""What stands in a section besides, the last ones made here because they are long."""


def attempt(random, valid, here):
    """A world's MJCF file, damaged, alone or in a folder, and a sample made of it."""
    document, said = random.choice((*[_number] * 4, *[_added] * 4, _text))(random)
    (here / "scene.toml").write_text((valid.folder / "scene.toml").read_text())
    os.mkfifo(here / "pipe")
    (here / "liar.stl").write_bytes(
        bytes(80) + struct.pack("<L", random.choice((0, 1, 2**31, 2**32 - 1))) + bytes(50)
    )
    size = random.choice(((65536, 65536), (-1, -1), (2, 2)))
    (here / "liar.bin").write_bytes(struct.pack("<ll", *size) + bytes(16))
    size = struct.pack(">LL", 2**31 - 1, 2**31 - 1)
    (here / "liar.png").write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + size + bytes(9))
    (here / "scene.xml").write_bytes(document)
    unseen = " --allow-unseen" if random.random() < 0.3 else ""
    return generated(f"--scene scene.xml --recipe scene.toml{unseen}", f"scene.xml: {said}")


def _number(random):
    """Other numbers in an attribute of numbers."""
    places = list(re.finditer(r'(\w+)="([^"a-z]+)"', SCENE))
    place = random.choice(places)
    numbers = place[2].split()
    value = random.choice(NUMBERS)
    numbers[random.randrange(len(numbers))] = value
    if random.random() < 0.3:
        numbers = [value] * len(numbers)
    changed = SCENE[: place.start(2)] + " ".join(numbers) + SCENE[place.end(2) :]
    line = SCENE[: place.start()].count("\n")
    return changed.encode(), changed.splitlines()[line][:150]


def _added(random):
    """Something more in one of the sections."""
    section = random.choice(list(ADDED))
    more, placed = random.choice(ADDED[section]), SCENE
    if section == "asset" and random.random() < 0.7:
        kind, name = re.match(r'<(\w+) name="(\w+)"', more).groups()  # type: ignore[union-attr]
        use = {
            "mesh": f'<geom type="mesh" mesh="{name}"/>',
            "hfield": f'<geom type="hfield" hfield="{name}"/>',
        }
        use["model"] = f'<attach model="{name}" body="cart" prefix="p"/>'
        placed = placed.replace("</worldbody>", use.get(kind, "") + "</worldbody>")
    return placed.replace(
        f"</{section}>", more + f"</{section}>"
    ).encode(), f"{more[:100]} in <{section}>"


def _text(random):
    """Something else as a whole."""
    bombs = "".join(f'<!ENTITY a{n} "{f"&a{n - 1};" * 10}">' for n in range(1, 10))
    entities = f'<!DOCTYPE x [<!ENTITY a0 "x">{bombs}]>' + SCENE.replace("small", "&a9;")
    outside = f'<!DOCTYPE x [<!ENTITY a SYSTEM "/etc/passwd">]>{SCENE}'
    other = b"", b"<mujoco/>", b"<robot/>", bytes(1000), b"<" * 100_000
    long = SCENE.replace("</mujoco>", " " * (20 << 20) + "</mujoco>")
    return random.choice(
        (
            (entities.encode(), "entities"),
            (outside.encode(), "an external entity"),
            (SCENE.encode(random.choice(("utf-16", "utf-32"))), "another encoding"),
            (random.choice(other), "something else"),
            (long.encode(), "20 MB of spaces"),
            *(damage(SCENE.encode(), random) for _ in range(2)),
        )
    )
