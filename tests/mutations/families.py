"""The families, by name."""

from tests.mutations import (
    damage_archives,
    damage_bytes,
    damage_hdf5,
    damage_logs,
    damage_manifest,
    damage_maps,
    damage_options,
    damage_points,
    damage_predictions,
    damage_recipes,
    damage_scenes,
    damage_weights,
)

FAMILIES = {
    module.__name__.rpartition("damage_")[2]: module.attempt
    for module in (
        *(damage_bytes, damage_hdf5, damage_manifest, damage_archives, damage_recipes),
        *(damage_scenes, damage_weights, damage_predictions, damage_points, damage_maps),
        *(damage_options, damage_logs),
    )
}
