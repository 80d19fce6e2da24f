"""What the paper reports, Tables I and II, mean±standard deviation, to stand beside ours."""

Row = dict[str, tuple[float, float | None]]


def _read(table: str) -> dict[str, dict[str, Row]]:
    """``tables[kind][method][metric]``: (mean, standard deviation, or None where the paper gives
    none). A line is a metric, a column a method."""
    columns, *lines = [line.split() for line in table.strip().splitlines()]
    found: dict[str, dict[str, Row]] = {}
    for metric, *cells in lines:
        for column, cell in zip(columns, cells, strict=True):
            kind, method = column.split("/")
            mean, _, std = cell.partition("±")
            row = found.setdefault(kind, {}).setdefault(method, {})
            row[metric] = float(mean), float(std) if std else None
    return found


RECONSTRUCTION = _read("""
          geometric/TUDF geometric/OCC geometric/Proposed pillar/TUDF pillar/OCC pillar/Proposed
rmse      .317±.097      .437±.123     .321±.097          .355±.069   .485±.095  .329±.068
mae       .162±.068      .203±.081     .162±.064          .214±.050   .251±.072  .191±.050
near_rmse .310±.111      .576±.156     .282±.113          .344±.075   .574±.112  .338±.079
near_mae  .157±.064      .313±.114     .141±.062          .186±.047   .308±.087  .177±.049
bias      .004±.050      .188±.082     -.028±.047         .016±.061   .238±.077  .026±.060
near_bias .101±.064      .305±.115     .064±.065          .134±.053   .304±.087  .128±.054
iou       .526±.068      .575±.081     .601±.080          .440±.043   .556±.058  .559±.058
f1        .687±.060      .727±.067     .747±.064          .610±.042   .713±.048  .715±.049
precision .830±.046      .966±.029     .867±.043          .681±.037   .976±.035  .890±.039
recall    .590±.077      .587±.083     .662±.090          .557±.065   .564±.057  .601±.065
""")
PLANNING = _read("""
              geometric/TUDF geometric/OCC geometric/Proposed pillar/TUDF pillar/OCC pillar/Proposed
success       .787           .778          .806               .846        .769        .885
length        9.377±1.279    9.156±1.020   9.404±1.281        8.639±3.885 7.873±1.572 8.525±3.881
min_clearance .985±.713      .917±.737     1.007±.698         .750±.403   .725±.418   .816±.370
avg_clearance 1.376±.675     1.347±.657    1.371±.683         1.312±.356  1.310±.268  1.326±.352
""")
