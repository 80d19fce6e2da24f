"""What the paper reports, Tables I and II: (mean, standard deviation), to stand beside our figures."""

Row = dict[str, tuple[float, float | None]]

RECONSTRUCTION: dict[str, dict[str, Row]] = {
    "geometric": {
        "TUDF": {
            "rmse": (0.317, 0.097),
            "mae": (0.162, 0.068),
            "near_rmse": (0.310, 0.111),
            "near_mae": (0.157, 0.064),
            "bias": (0.004, 0.050),
            "near_bias": (0.101, 0.064),
            "iou": (0.526, 0.068),
            "f1": (0.687, 0.060),
            "precision": (0.830, 0.046),
            "recall": (0.590, 0.077),
        },
        "OCC": {
            "rmse": (0.437, 0.123),
            "mae": (0.203, 0.081),
            "near_rmse": (0.576, 0.156),
            "near_mae": (0.313, 0.114),
            "bias": (0.188, 0.082),
            "near_bias": (0.305, 0.115),
            "iou": (0.575, 0.081),
            "f1": (0.727, 0.067),
            "precision": (0.966, 0.029),
            "recall": (0.587, 0.083),
        },
        "Proposed": {
            "rmse": (0.321, 0.097),
            "mae": (0.162, 0.064),
            "near_rmse": (0.282, 0.113),
            "near_mae": (0.141, 0.062),
            "bias": (-0.028, 0.047),
            "near_bias": (0.064, 0.065),
            "iou": (0.601, 0.080),
            "f1": (0.747, 0.064),
            "precision": (0.867, 0.043),
            "recall": (0.662, 0.090),
        },
    },
    "pillar": {
        "TUDF": {
            "rmse": (0.355, 0.069),
            "mae": (0.214, 0.050),
            "near_rmse": (0.344, 0.075),
            "near_mae": (0.186, 0.047),
            "bias": (0.016, 0.061),
            "near_bias": (0.134, 0.053),
            "iou": (0.440, 0.043),
            "f1": (0.610, 0.042),
            "precision": (0.681, 0.037),
            "recall": (0.557, 0.065),
        },
        "OCC": {
            "rmse": (0.485, 0.095),
            "mae": (0.251, 0.072),
            "near_rmse": (0.574, 0.112),
            "near_mae": (0.308, 0.087),
            "bias": (0.238, 0.077),
            "near_bias": (0.304, 0.087),
            "iou": (0.556, 0.058),
            "f1": (0.713, 0.048),
            "precision": (0.976, 0.035),
            "recall": (0.564, 0.057),
        },
        "Proposed": {
            "rmse": (0.329, 0.068),
            "mae": (0.191, 0.050),
            "near_rmse": (0.338, 0.079),
            "near_mae": (0.177, 0.049),
            "bias": (0.026, 0.060),
            "near_bias": (0.128, 0.054),
            "iou": (0.559, 0.058),
            "f1": (0.715, 0.049),
            "precision": (0.890, 0.039),
            "recall": (0.601, 0.065),
        },
    },
}

PLANNING: dict[str, dict[str, Row]] = {
    "geometric": {
        "TUDF": {
            "success": (0.787, None),
            "length": (9.377, 1.279),
            "min_clearance": (0.985, 0.713),
            "avg_clearance": (1.376, 0.675),
        },
        "OCC": {
            "success": (0.778, None),
            "length": (9.156, 1.020),
            "min_clearance": (0.917, 0.737),
            "avg_clearance": (1.347, 0.657),
        },
        "Proposed": {
            "success": (0.806, None),
            "length": (9.404, 1.281),
            "min_clearance": (1.007, 0.698),
            "avg_clearance": (1.371, 0.683),
        },
    },
    "pillar": {
        "TUDF": {
            "success": (0.846, None),
            "length": (8.639, 3.885),
            "min_clearance": (0.750, 0.403),
            "avg_clearance": (1.312, 0.356),
        },
        "OCC": {
            "success": (0.769, None),
            "length": (7.873, 1.572),
            "min_clearance": (0.725, 0.418),
            "avg_clearance": (1.310, 0.268),
        },
        "Proposed": {
            "success": (0.885, None),
            "length": (8.525, 3.881),
            "min_clearance": (0.816, 0.370),
            "avg_clearance": (1.326, 0.352),
        },
    },
}
