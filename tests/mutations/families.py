"""The families, by name."""

from tests.mutations import (
    damage_bytes,
    damage_files,
    damage_hdf5,
    damage_options,
    damage_predictions,
    damage_recipes,
    damage_scenes,
    damage_weights,
)

FAMILIES = {
    module.__name__.rpartition("damage_")[2]: module.attempt
    for module in (
        *(damage_bytes, damage_hdf5, damage_recipes),
        *(damage_scenes, damage_weights, damage_predictions, damage_files, damage_options),
    )
}
