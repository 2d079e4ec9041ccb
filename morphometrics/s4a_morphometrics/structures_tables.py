"""Output of the commands of multi-structure studies."""

import numpy as np
import xarray as xr

from s4a.cli.tables import table
from s4a.method.pca import mahalanobis


def structure_lines(result: xr.Dataset) -> str:
    """Return a table of the variation of each structure in pose and in shape.

    Parameters
    ----------
    result : Dataset
        From :func:`s4a_morphometrics.structures`.
    """
    unit = result["position"].attrs["units"]
    area, structure = result["vertex_area"].values, result["structure_of_vertex"].values
    total, rows = area.sum(), []
    for k, name in enumerate(result["structure"].values.tolist()):
        part = area[structure == k].sum() / total
        variance = result["level_variance"].values[k] / part
        share = 100 * result["level_share"].values[k]
        angle = np.degrees(np.sqrt((result["pose_rotation"].values[:, k] ** 2).sum(1).mean()))
        translation = np.sqrt((result["pose_translation"].values[:, k] ** 2).sum(1).mean())
        cells = [f"{100 * part:.0f} %", f"{angle:.1f}", f"{translation:.3g}"]
        cells += [f"{deviation:.3g}" for deviation in np.sqrt(variance)]
        rows.append([name, *cells, *(f"{s:.1f} %" for s in share)])
    whole = 100 * result["level_share"].sum("structure").values
    sizes = np.sqrt(result["level_variance"].sum("structure").values)
    rows.append(["all", "100 %", "", "", *(f"{size:.3g}" for size in sizes)])
    rows[-1] += [f"{share:.1f} %" for share in whole]
    head = ["structure", "area", "rotation (degrees)", f"translation ({unit})"]
    head += [f"between ({unit})"]
    head += [f"within ({unit})", "share between", "share within"]
    lines = [f"{result.sizes['shape']} subjects", table(rows, head)]
    if np.isfinite(result["pose_shape_rv"]):
        lines.append(
            f"poses and shapes together: RV = {result['pose_shape_rv'].item():.2f}, "
            f"p = {result['pose_shape_p'].item():.3g}"
        )
    return "\n".join(lines)


def pose_table(new: xr.Dataset) -> str:
    """Return a table of pose and difference in shape of each structure of new subjects.

    Parameters
    ----------
    new : Dataset
        From :func:`s4a_morphometrics.structures_of_new`.
    """
    unit = new["position"].attrs["units"]
    area, structure = new["vertex_area"].values, new["structure_of_vertex"].values
    squared = (new["within_displacement"].values.astype(float) ** 2).sum(2)  # (s, n)
    rows = []
    for i, subject in enumerate(new["shape"].values.tolist()):
        for k, name in enumerate(new["structure"].values.tolist()):
            angle = np.degrees(np.linalg.norm(new["pose_rotation"].values[i, k]))
            translation = np.linalg.norm(new["pose_translation"].values[i, k])
            at = structure == k
            within = np.sqrt(np.average(squared[i, at], weights=area[at]))
            lengths = (translation, new["pose_size"].values[i, k], within)
            rows.append([subject, name, f"{angle:.1f}", *(f"{x:.3g}" for x in lengths)])
    head = ["subject", "structure", "rotation (degrees)", f"translation ({unit})"]
    return table(rows, [*head, f"between ({unit})", f"within ({unit})"])


def new_score_lines(pca: xr.Dataset) -> str:
    """Return lines on the scores of new subjects on the modes of the study."""
    lines = []
    for name, row in zip(pca["shape"].values.tolist(), pca["score"].values, strict=True):
        scores = " ".join(f"{score:+.2f}" for score in row[:5])
        lines.append(f"  {name}: Mahalanobis {mahalanobis(row):.1f}, scores {scores}")
    return "\n".join(lines)
