"""The paper once more (3.3 to 6.1), independent of S4A: numpy, scipy and pyFM (pyfmaps 1.3.1) only.

It takes the clean meshes of a study and what remeshing makes of them (the low-resolution meshes and
U), and computes everything else from the equations of the paper, with brute-force searches.  What
the paper leaves open is as in docs/differences.md.  The signs of eigenfunctions and latent
functions, which are arbitrary, are those of the study.
"""

import itertools

import numpy as np
from pyFM.FMN import FMN
from pyFM.mesh import TriMesh
from scipy.linalg import eigh
from scipy.sparse import csr_matrix, diags
from scipy.spatial.distance import cdist


def areas(X, T):
    """Areas of the triangles."""
    return np.linalg.norm(np.cross(X[T[:, 1]] - X[T[:, 0]], X[T[:, 2]] - X[T[:, 0]]), axis=1) / 2


class Shape:
    """A shape of unit area at both resolutions, with U and k eigenpairs (3.1, 3.3, 4.1)."""

    def __init__(self, original, coarse, k):
        X, T = original["position"].values, original["corner_vertex"].values
        self.area = np.bincount(T.ravel(), np.repeat(areas(X, T) / 3, 3), len(X))
        self.size, self.center = np.sqrt(self.area.sum()), self.area @ X / self.area.sum()
        self.U = np.zeros((len(X), coarse.sizes["vertex"]))
        rows = np.arange(len(X))[:, None]
        np.add.at(self.U, (rows, coarse["coarse_vertex"].values), coarse["coarse_weight"].values)
        self.full = (X - self.center) / self.size
        self.X = (coarse["position"].values - self.center) / self.size
        self.T = coarse["corner_vertex"].values
        self.A = self.U.T @ self.area / self.size**2
        self.alone = self.X - self.A @ self.X  # in the frame of the low-resolution mesh
        W = np.zeros((len(self.X),) * 2)
        for i, j, o in np.concatenate([np.roll(self.T, s, axis=1) for s in range(3)]):
            a, b = self.X[i] - self.X[o], self.X[j] - self.X[o]
            w = a @ b / np.linalg.norm(np.cross(a, b)) / 2  # half a cotangent
            W[[i, j, i, j], [j, i, i, j]] += [-w, -w, w, w]
        self.eigenvalue, self.Phi = eigh(W, np.diag(self.A), subset_by_index=(0, k - 1))
        self.eigenvalue[0] = 0
        self.Phi *= np.sign((self.Phi * coarse["eigenfunction"].values[:, :k]).sum(0))


def icp(X, Y):
    """Point-to-point ICP from the given pose: R, t with R x + t near Y (4.1, step 2)."""
    R, t, before = np.eye(3), np.zeros(3), np.inf
    while True:
        distance = cdist(X @ R.T + t, Y)
        rms = np.sqrt((distance.min(1) ** 2).mean())
        if before - rms < 1e-6:
            return R, t
        before, Q = rms, Y[distance.argmin(1)]
        U, _, Vt = np.linalg.svd((Q - Q.mean(0)).T @ (X - X.mean(0)))
        R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
        t = Q.mean(0) - R @ X.mean(0)


def farthest(X, n):
    """Farthest-point samples, the first of them the farthest from the mean (step 3)."""
    sample = [np.linalg.norm(X - X.mean(0), axis=1).argmax()]
    while len(sample) < n:
        sample.append(cdist(X, X[sample]).min(1).argmax())
    return np.array(sample)


def fit(M, N, marks, k):
    """Map that preserves heat kernels around landmarks, C 1 = 1 (step 4)."""
    spectra = M.eigenvalue[:k], N.eigenvalue[:k]
    last, first = min(s[-1] for s in spectra), max(s[1] for s in spectra)
    times = np.geomspace(4 * np.log(10) / last, 4 * np.log(10) / first, 8)
    ends = []
    for shape, spectrum, mark in zip((M, N), spectra, marks, strict=True):
        kernel = np.exp(-np.outer(spectrum, times))  # (k, 8)
        f = (kernel[:, None] * shape.Phi[mark, :k].T[:, :, None]).reshape(k, -1)
        ends.append(f / np.linalg.norm(f, axis=0))
    F, G = ends
    penalty = (
        1e-3 * (F**2).sum() * (np.subtract.outer(*spectra[::-1]) / max(map(max, spectra))) ** 2
    )
    C = np.zeros((k, k))
    C[0, 0] = np.sign(M.Phi[0, 0] * N.Phi[0, 0])
    for row, g, p in zip(C, G, penalty, strict=True):
        system = np.concatenate([F[1:].T, np.diag(np.sqrt(p[1:]))])
        row[1:] = np.linalg.lstsq(system, np.r_[g - row[0] * F[0], np.zeros(k - 1)])[0]
    return C


def nearest(rows, query):
    """KnnSearch(query, rows)."""
    return cdist(query, rows).argmin(1)


def weights(maps):
    """Weights exp(-(e / s)^2 / 2), e the mean error of the 3-cycles of a map, s its median."""
    errors = {edge: [] for edge in maps}
    for i, j, k in itertools.permutations(range(1 + max(map(max, maps))), 3):
        product = maps[k, i] @ maps[j, k] @ maps[i, j]
        errors[i, j].append(np.linalg.norm(product - np.eye(len(product))))
        errors[j, k].append(errors[i, j][-1])
        errors[k, i].append(errors[i, j][-1])
    mean = np.array([np.mean(errors[edge]) for edge in maps])
    return csr_matrix((np.exp(-((mean / np.median(mean)) ** 2) / 2), np.array([*maps]).T))


def consistent_zoomout(shapes, maps, k, step=5):
    """Refined maps, latent bases and eigenvalues, by pyFM with the weights above (3.4, 4.2)."""
    meshes = []
    for s in shapes:
        meshes.append(TriMesh(s.X, s.T))
        meshes[-1].eigenvalues, meshes[-1].eigenvectors = s.eigenvalue, s.Phi
        meshes[-1].A = diags(s.A)
    network = FMN(meshes, maps)
    for size in range(len(maps[0, 1]), k, step):
        network.set_weights(weights(network.maps))
        options = {"isometric": False, "weight_type": "adjacency", "complete": True}
        network.zoomout_iteration(size, size, min(size + step, k), **options)
    network.set_weights(weights(network.maps))
    network.compute_W(M=k)
    network.compute_CLB()
    network.compute_CCLB(k, verbose=False)
    return network.maps, network.CCLB, network.cclb_eigenvalues


def paper(study, k_init, k):
    """All intermediate results of ``preset="paper"``, by name."""
    names = study["latent"]["shape"].values.tolist()
    shapes = [Shape(study["original"][n], study["coarse"][n], k) for n in names]
    logs = np.log([s.eigenvalue[1:k_init] for s in shapes])
    found = {"shapes": shapes, "spectral_distance": cdist(logs, logs) / np.sqrt(k_init - 1)}
    found |= {"transforms": {}, "landmarks": {}, "fitted": {}, "initial": {}}
    for i, j in itertools.permutations(range(len(names)), 2):
        M, N = shapes[i], shapes[j]
        R, t = icp(M.alone, N.alone) if i < j else invert(*found["transforms"][j, i])
        source = farthest(M.X, 10)
        marks = source, nearest(N.alone, M.alone[source] @ R.T + t)
        C = fit(M, N, marks, k_init)
        match = nearest(M.Phi[:, :k_init] @ C.T, N.Phi[:, :k_init])  # eq. 2
        found["transforms"][i, j], found["landmarks"][i, j], found["fitted"][i, j] = (
            (R, t),
            marks,
            C,
        )
        found["initial"][i, j] = N.Phi[:, :k_init].T @ (N.A[:, None] * M.Phi[match, :k_init])
    found["maps"], Y, latent = consistent_zoomout(shapes, found["initial"], k)
    Y = Y * np.sign((Y * study["latent"]["latent_basis"].values).sum((0, 1)))
    D = np.einsum("nkl,nkm->nlm", Y, Y)
    energy = [np.linalg.norm((d - np.eye(k))[1:, 1:] / latent[1:]) for d in D]  # eq. 5
    found |= {"latent": Y, "latent_eigenvalue": latent, "energy": energy}
    median = int(np.argmin(energy))
    found |= {"median": names[median], "low": [], "match": [], "raw": [], "smooth": []}
    N, X = shapes[median], shapes[median].full * shapes[median].size
    B = N.U @ N.Phi
    for i, M in enumerate(shapes):
        found["low"].append(nearest(M.Phi @ Y[i], N.Phi @ Y[median]))  # eq. 6
        found["match"].append(nearest(M.U @ M.Phi @ Y[i], B @ Y[median]))  # eq. 7
        if i == median:
            found["low"][i], found["match"][i] = np.arange(len(N.X)), np.arange(len(X))
        R, t = icp(M.X, N.X)
        image = M.full[found["match"][i]] * M.size @ R.T + t * N.size
        found["raw"].append(image - X if i != median else 0 * X)  # eq. 8 with the other sign
        found["smooth"].append(B @ np.linalg.lstsq(B, found["raw"][i])[0])
    root = np.sqrt(N.area / N.area.sum())
    centered = (found["smooth"] - np.mean(found["smooth"], 0)) * root[:, None]
    _, sd, modes = np.linalg.svd(centered.reshape(len(names), -1), full_matrices=False)
    return found | {"sd": sd[:-1] / np.sqrt(len(names) - 1), "modes": modes[:-1], "root": root}


def invert(R, t):
    """The inverse of R x + t."""
    return R.T, -R.T @ t
