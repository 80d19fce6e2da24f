"""Pictures show what is there: a block where a voxel is, what is nearer in front, and PNGs that
others read."""

import io

import matplotlib.image
import numpy as np

from scenegen.display.blocks import FLOOR, PAPER, SENSOR, draw_blocks, draw_level, to_png


def painted(mask: np.ndarray) -> np.ndarray:
    image = draw_blocks(mask)
    plain = [(image == colour).all(axis=-1) for colour in (PAPER, FLOOR, SENSOR)]
    return ~np.logical_or.reduce(plain)


def one(*place: int) -> np.ndarray:
    mask = np.zeros((12, 10, 6), bool)
    mask[place] = True
    return mask


def test_a_block_stands_where_its_voxel_is() -> None:
    centre = [
        np.argwhere(painted(one(*place))).mean(axis=0)
        for place in ((2, 2, 1), (7, 2, 1), (2, 7, 1), (2, 2, 4))
    ]
    here, further_x, further_y, higher = centre
    assert further_x[0] > here[0] + 5  # x goes down …
    assert further_x[1] > here[1] + 5  # … and right
    assert further_y[0] < here[0] - 5  # y goes up
    assert further_y[1] > here[1] + 5  # and right
    assert higher[0] < here[0] - 5
    assert abs(higher[1] - here[1]) < 1


def test_what_is_nearer_hides_what_is_behind() -> None:
    behind, front = one(5, 5, 2), one(6, 4, 3)  # on one line of sight
    both = draw_blocks(behind | front)
    top = painted(front)
    assert np.array_equal(both[top], draw_blocks(front)[top])
    assert np.array_equal(painted(behind | front), painted(behind) | top)


def test_inner_voxels_change_nothing() -> None:
    full = np.zeros((12, 10, 6), bool)
    full[3:8, 2:9, 1:5] = True
    hollow = full.copy()
    hollow[4:7, 3:8, 2:4] = False
    assert np.array_equal(draw_blocks(full), draw_blocks(hollow))


def test_levels_are_drawn_x_right_and_y_up() -> None:
    shares = np.zeros((8, 4))
    shares[7, 0] = 1.0
    panel = draw_level(shares, height=80).astype(int).sum(axis=-1)
    rows, columns = np.nonzero((panel > 600) & (panel < 765))
    assert rows.mean() > 50  # y is least: at the foot
    assert columns.mean() > 70


def test_others_read_the_png() -> None:
    image = np.random.default_rng(0).integers(0, 256, (31, 17, 3), dtype=np.uint8)
    read = matplotlib.image.imread(io.BytesIO(to_png(image)))
    assert np.array_equal((read[..., :3] * 255).round().astype(np.uint8), image)
