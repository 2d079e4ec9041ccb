"""What the commands of several structures print."""

import numpy as np
import xarray as xr

from s4a.cli.tables import table
from s4a.method.pca import mahalanobis


def structure_lines(found: xr.Dataset) -> str:
    """How much each structure varies in its pose and in its shape, as a table.

    Parameters
    ----------
    found : Dataset
        See :func:`s4a_morphometrics.poses.structures`.
    """
    unit = found["position"].attrs["units"]
    area, of = found["vertex_area"].values, found["structure_of_vertex"].values
    total, rows = area.sum(), []
    for k, name in enumerate(found["structure"].values.tolist()):
        part = area[of == k].sum() / total
        variance = found["level_variance"].values[k] / part
        share = 100 * found["level_share"].values[k]
        turn = np.degrees(np.sqrt((found["pose_rotation"].values[:, k] ** 2).sum(1).mean()))
        shift = np.sqrt((found["pose_translation"].values[:, k] ** 2).sum(1).mean())
        cells = [f"{100 * part:.0f} %", f"{turn:.1f}", f"{shift:.3g}"]
        cells += [f"{one:.3g}" for one in np.sqrt(variance)]
        rows.append([name, *cells, *(f"{one:.1f} %" for one in share)])
    whole = 100 * found["level_share"].sum("structure").values
    sizes = np.sqrt(found["level_variance"].sum("structure").values)
    rows.append(["all", "100 %", "", "", *(f"{one:.3g}" for one in sizes)])
    rows[-1] += [f"{one:.1f} %" for one in whole]
    head = ["structure", "area", "turn (degrees)", f"shift ({unit})", f"between ({unit})"]
    head += [f"within ({unit})", "share between", "share within"]
    lines = [f"{found.sizes['shape']} subjects", table(rows, head)]
    if np.isfinite(found["pose_shape_rv"]):
        lines.append(
            f"poses and shapes together: RV = {found['pose_shape_rv'].item():.2f}, "
            f"p = {found['pose_shape_p'].item():.3g}"
        )
    return "\n".join(lines)


def pose_table(new: xr.Dataset) -> str:
    """How each structure of new subjects lies, and how much its shape differs, as a table.

    Parameters
    ----------
    new : Dataset
        See :func:`s4a_morphometrics.poses.structures_of_new`.
    """
    unit = new["position"].attrs["units"]
    area, of = new["vertex_area"].values, new["structure_of_vertex"].values
    squared = (new["within_displacement"].values.astype(float) ** 2).sum(2)  # (s, n)
    rows = []
    for i, subject in enumerate(new["shape"].values.tolist()):
        for k, name in enumerate(new["structure"].values.tolist()):
            turn = np.degrees(np.linalg.norm(new["pose_rotation"].values[i, k]))
            shift = np.linalg.norm(new["pose_translation"].values[i, k])
            within = np.sqrt(np.average(squared[i, of == k], weights=area[of == k]))
            size = new["pose_size"].values[i, k]
            rows.append(
                [subject, name, f"{turn:.1f}", *(f"{x:.3g}" for x in (shift, size, within))]
            )
    head = ["subject", "structure", "turn (degrees)", f"shift ({unit})"]
    return table(rows, [*head, f"between ({unit})", f"within ({unit})"])


def new_score_lines(pca: xr.Dataset) -> str:
    """The scores of new subjects on frozen modes, in words."""
    lines = []
    for name, row in zip(pca["shape"].values.tolist(), pca["score"].values, strict=True):
        said = " ".join(f"{score:+.2f}" for score in row[:5])
        lines.append(f"  {name}: Mahalanobis {mahalanobis(row):.1f}, scores {said}")
    return "\n".join(lines)
