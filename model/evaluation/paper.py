"""What the paper reports, Tables I and II, mean±standard deviation, to stand beside our figures."""

Row = dict[str, tuple[float, float | None]]


def _read(table: str) -> dict[str, dict[str, Row]]:
    """``tables[kind][method][metric]``: (mean, standard deviation, or None where the paper gives
    none)."""
    names, *rows = [line.split() for line in table.strip().splitlines()]
    found: dict[str, dict[str, Row]] = {}
    for kind, method, *cells in rows:
        pairs = (cell.partition("±") for cell in cells)
        values = ((float(mean), float(std) if std else None) for mean, _, std in pairs)
        found.setdefault(kind, {})[method] = dict(zip(names, values, strict=True))
    return found


RECONSTRUCTION = _read("""
                   rmse      mae       near_rmse near_mae  bias       near_bias iou       f1        precision recall
geometric TUDF     .317±.097 .162±.068 .310±.111 .157±.064 .004±.050  .101±.064 .526±.068 .687±.060 .830±.046 .590±.077
geometric OCC      .437±.123 .203±.081 .576±.156 .313±.114 .188±.082  .305±.115 .575±.081 .727±.067 .966±.029 .587±.083
geometric Proposed .321±.097 .162±.064 .282±.113 .141±.062 -.028±.047 .064±.065 .601±.080 .747±.064 .867±.043 .662±.090
pillar TUDF        .355±.069 .214±.050 .344±.075 .186±.047 .016±.061  .134±.053 .440±.043 .610±.042 .681±.037 .557±.065
pillar OCC         .485±.095 .251±.072 .574±.112 .308±.087 .238±.077  .304±.087 .556±.058 .713±.048 .976±.035 .564±.057
pillar Proposed    .329±.068 .191±.050 .338±.079 .177±.049 .026±.060  .128±.054 .559±.058 .715±.049 .890±.039 .601±.065
""")
PLANNING = _read("""
                   success length      min_clearance avg_clearance
geometric TUDF     .787    9.377±1.279 .985±.713     1.376±.675
geometric OCC      .778    9.156±1.020 .917±.737     1.347±.657
geometric Proposed .806    9.404±1.281 1.007±.698    1.371±.683
pillar TUDF        .846    8.639±3.885 .750±.403     1.312±.356
pillar OCC         .769    7.873±1.572 .725±.418     1.310±.268
pillar Proposed    .885    8.525±3.881 .816±.370     1.326±.352
""")
