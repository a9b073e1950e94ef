"""Slow twins of the fast code: short, obviously right, and used only by tests."""

import numpy as np
from scipy.spatial.transform import Rotation

from steelnb.hough import directions


def voxel_grid(points, leaf_m):
    cubes = {}
    for point in points:
        cubes.setdefault(tuple(np.floor(point / leaf_m).astype(int)), []).append(point)
    return np.array([np.mean(cubes[cube], axis=0) for cube in sorted(cubes)])


def hough_lines(points, dx, min_votes=2, max_lines=None, granularity=2):
    """The iterative Hough transform with a full vote volume, as in the paper: [(anchor, direction, indices), …]."""
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    low, high = points.min(axis=0) - centre, points.max(axis=0) - centre
    half = max(np.linalg.norm(low), np.linalg.norm(high))
    columns = int(2 * half / dx + 0.5)
    sphere = directions(granularity)
    left, lines = np.arange(len(points)), []
    while len(left) > 1 and (max_lines is None or len(lines) < max_lines):
        shifted = points[left] - centre
        volume = np.zeros((columns * columns, len(sphere)), dtype=int)
        for j, (bx, by, bz) in enumerate(sphere):
            beta = 1 / (1 + bz)
            for px, py, pz in shifted:
                x = (1 - beta * bx * bx) * px - beta * bx * by * py - bx * pz
                y = -beta * bx * by * px + (1 - beta * by * by) * py - by * pz
                cell = int((x + half) / dx + 0.5) * columns + int((y + half) / dx + 0.5)
                if cell < columns * columns:
                    volume[cell, j] += 1
        cell, j = np.unravel_index(volume.argmax(), volume.shape)  # the first of equals: smallest cell, then direction
        bx, by, bz = b = sphere[j]
        x, y, beta = (cell // columns) * dx - half, (cell % columns) * dx - half, 1 / (1 + bz)
        a = np.array([x * (1 - beta * bx * bx) - y * beta * bx * by, -x * beta * bx * by + y * (1 - beta * by * by),
                      -x * bx - y * by])  # fmt: skip
        near = close_to_line(shifted, a, b, dx)
        a, b = fit_line(shifted[near])
        near = close_to_line(shifted, a, b, dx)
        if near.sum() < min_votes:
            break
        a, b = fit_line(shifted[near])
        lines.append((a + centre, b, left[near]))
        left = left[~near]
    return lines


def close_to_line(points, anchor, direction, distance):
    apart = points - anchor
    return np.linalg.norm(apart - np.outer(apart @ direction, direction), axis=1) <= distance


def fit_line(points):
    mean = points.mean(axis=0)
    return mean, np.linalg.eigh((points - mean).T @ (points - mean))[1][:, 2]


def merged(points, pieces, distance, gap_max):
    """Sets of numbers of the pieces (first, one past last) that are copies of one bar, the largest piece first."""

    def axis(some):
        mean, u = fit_line(points[some])
        t = (points[some] - mean) @ u
        return mean, u, mean + np.outer([t.min(), t.max()], u)

    index = [list(range(a, b)) for a, b in pieces]
    ends = [axis(some)[2] for some in index]
    left = sorted(range(len(pieces)), key=lambda k: -len(index[k]))
    groups = []
    while left:
        group = [left.pop(0)]
        corners = ends[group[0]]
        grown = True
        while grown:
            grown = False
            for k in list(left):
                mean, u, _ = axis([i for j in group for i in index[j]])
                along = np.sort((corners - mean) @ u)
                apart = ends[k] - mean
                t = apart @ u
                across = np.linalg.norm(apart - np.outer(t, u), axis=1)
                if (
                    abs(axis(index[k])[1] @ u) >= np.cos(np.radians(10))
                    and (across <= distance).all()
                    and t.min() <= along[-1] + gap_max
                    and t.max() >= along[0] - gap_max
                ):
                    left.remove(k)
                    group.append(k)
                    mean, u, _ = axis([i for j in group for i in index[j]])
                    t = (np.concatenate([corners, ends[k]]) - mean) @ u
                    corners = mean + np.outer([t.min(), t.max()], u)
                    grown = True
        groups.append(set(group))
    return groups


def full(upper):
    """Upper triangles (N, 6), xx xy xz yy yz zz, as symmetric matrices (N, 3, 3)."""
    return np.asarray(upper)[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]


def nearest_k(points, query, k):
    """(positions, distances) of the k nearest, nearest first."""
    distance = np.linalg.norm(points - query, axis=1)
    order = np.argsort(distance, kind="stable")[:k]
    return order, distance[order]


def covariances(points, k):
    result = []
    for point in points:
        near = points[nearest_k(points, point, k)[0]]
        result.append(np.cov(near.T, bias=True))
    return np.array(result)


def pairs(points, target, limit):
    """Position of the nearest target point within the limit, or −1."""
    result = []
    for point in points:
        order, distance = nearest_k(target, point, 1)
        result.append(order[0] if distance[0] <= limit else -1)
    return np.array(result)


def voxel_moments(points, weights, voxel_m):
    """{cube: (weight, mean, covariance of the points in the 27 cubes about it)}."""
    cube = np.floor(points / voxel_m).astype(int)
    result = {}
    for key in {tuple(c) for c in cube}:
        own = (cube == key).all(axis=1)
        about = (np.abs(cube - key) <= 1).all(axis=1)
        result[key] = (
            weights[own].sum(),
            np.average(points[own], axis=0, weights=weights[own]),
            np.cov(points[about].T, aweights=weights[about], bias=True),
        )
    return result


def robust(squared, scale):
    """Geman and McClure's loss of a squared residual: ½ r² for small r."""
    r = np.sqrt(squared)
    return 0.5 * r**2 / (1 + (r / scale) ** 2)


def registration_terms(error, source, C_source, target, normal, C_target, match, T, R, limit):
    """[(residual vector, root of its metric, point), …]: the terms whose squares ICP sums up, one by one."""
    terms = []
    for i, j in enumerate(match):
        q = T[:3, :3] @ source[i] + T[:3, 3]
        e = q - target[j]
        if j < 0 or np.linalg.norm(e) > limit:
            continue
        if error == "plane":
            root = normal[j][None]
        elif error == "gicp":
            root = np.linalg.cholesky(np.linalg.inv(C_target[j] + R @ C_source[i] @ R.T)).T
        else:
            root = np.eye(3)
        terms.append((e, root, q))
    return terms


def gicp_cost(x, source, target, metric):
    """`bfgs.mean_cost` in double precision: ``x`` is a translation, then roll, pitch and yaw."""
    apart = source.astype(float) @ Rotation.from_euler("xyz", x[3:]).as_matrix().T + x[:3] - target
    return np.mean([e @ M @ e for e, M in zip(apart, full(metric), strict=True)])


def mixed(range_m, light, detour, detour_light, ambiguity_m=7.5):
    """Range and equivalent range of a pixel of a phase-measuring camera: the sum of its complex returns."""
    returns = [(r, a) for r, a in zip(range_m, light, strict=True) if a > 0]
    if not returns:
        return np.inf, np.inf
    returns += [(r, a) for r, a in zip(detour, detour_light, strict=True) if a > 0]
    total = sum(a * np.exp(2j * np.pi * r / ambiguity_m) for r, a in returns)
    strongest = range_m[np.argmax(light)]
    periods = round((strongest - np.angle(total) / (2 * np.pi) * ambiguity_m) / ambiguity_m)
    return (np.angle(total) / (2 * np.pi) + periods) * ambiguity_m, 1 / np.sqrt(abs(total) / len(range_m))


def loam_features(image, edges, planes, side=5, regions=4, smooth=5e-3, grazing=4.0, step_m=0.15):
    """(point, plane, rank) of LOAM's features, line by line, by its published rules."""
    found = []
    for row in image:
        columns = np.flatnonzero(np.isfinite(row).all(axis=1))
        p, n = row[columns], len(columns)
        if n < 2 * side + regions:
            continue
        distance = np.linalg.norm(p, axis=1)
        smoothness = {
            k: np.linalg.norm((p[k] - p[k - side : k + side + 1]).sum(axis=0)) / (2 * side * distance[k])
            for k in range(side, n - side)
        }
        closed = set(range(side)) | set(range(n - side, n))
        for k in range(1, n - 1):
            if columns[k + 1] - columns[k] <= side and distance[k] - distance[k + 1] > step_m:
                closed |= set(range(max(k - side, 0), k + 1))
            if columns[k + 1] - columns[k] <= side and distance[k + 1] - distance[k] > step_m:
                closed |= set(range(k + 1, min(k + 2 + side, n)))
            along = [abs(distance[k] - distance[j]) for j in (k - 1, k + 1)]
            apart = [np.linalg.norm(p[k] - p[j]) for j in (k - 1, k + 1)]
            if all(a > grazing * np.sqrt(d**2 - a**2) for a, d in zip(along, apart, strict=True)):
                closed.add(k)
        for region in range(regions):
            bounds = [side + (n - 2 * side) * (region + i) // regions for i in (0, 1)]
            order = sorted(range(*bounds), key=smoothness.get)
            for plane, most, candidates in ((0, edges, order[::-1]), (1, planes, order)):
                chosen = 0
                for k in candidates:
                    if chosen == most or (smoothness[k] >= smooth) == bool(plane):
                        break
                    if k in closed:
                        continue
                    found.append((p[k], plane, chosen))
                    chosen += 1
                    closed.add(k)
                    for way in (-1, 1):
                        for j in range(k + way, k + way * (side + 1), way):
                            if not 0 <= j < n or np.linalg.norm(p[j] - p[j - way]) > step_m:
                                break
                            closed.add(j)
    return found


def match_features(
    pixel, octave, descriptor, depth, expected, expected_octave, expected_depth, wanted, search_px, hamming_max, ratio
):
    """The rule of `steelnb.odometry.orb_features.match` from whole tables."""
    bits = np.unpackbits((wanted[:, None] ^ descriptor[None]).view(np.uint8), axis=2).sum(axis=2).astype(float)
    with np.errstate(invalid="ignore"):
        other_depth = np.abs(expected_depth[:, None] - depth) > 5 * np.maximum(0.01, 0.01 * depth)
    far = np.linalg.norm(expected[:, None] - pixel, axis=2) > search_px
    bits[far | other_depth | (np.abs(expected_octave[:, None] - octave) > 1)] = 257
    best, second = np.sort(bits, axis=1)[:, :2].T
    found = np.where((best <= hamming_max) & (best <= ratio * second), bits.argmin(axis=1), -1)
    for m in np.flatnonzero(found >= 0):
        rivals = np.flatnonzero(found == found[m])
        found[rivals[rivals != rivals[np.argmin(best[rivals])]]] = -1
    return found


def plane_depth(pixel, depth, place, radius):
    """Depths at places by `np.linalg.lstsq` of the inverse depths around."""
    result = []
    for at in place:
        near = np.linalg.norm(pixel - at, axis=1) <= radius
        A = np.column_stack([np.ones(near.sum()), pixel[near] - at])
        result.append(1 / np.linalg.lstsq(A, 1 / depth[near], rcond=None)[0][0])
    return np.array(result)


def convolution(x, kernel, stride):
    """Cross-correlation of images ``(B, H, W, C_in)`` with ``kernel (C_out, C_in, k, k)``, a window at a time."""
    pad = kernel.shape[-1] // 2
    x = np.pad(x, ((0, 0), (pad, pad), (pad, pad), (0, 0)))
    rows, columns = (range(0, size - 2 * pad, stride) for size in x.shape[1:3])
    result = np.zeros((len(x), len(rows), len(columns), len(kernel)))
    for b, i, j, c in np.ndindex(result.shape):
        top, left = rows[i], columns[j]
        window = x[b, top : top + 2 * pad + 1, left : left + 2 * pad + 1]
        result[b, i, j, c] = (window.transpose(2, 0, 1) * kernel[c]).sum()
    return result


def circle_step(cells, place, robust_m=0.03):
    """Cost of a circle, and the Gauss–Newton matrix and vector of its position, by numerical derivatives."""

    def residual(cell, at):
        u, v = cell[0] - at[0] - cell[5] * at[2], cell[1] - at[1] - cell[5] * at[3]
        depth, beside = cell[3] * u + cell[4] * v, -cell[4] * u + cell[3] * v
        if abs(beside) < 0.999 * at[4]:
            return depth - np.sqrt(at[4] ** 2 - beside**2), at[4] ** 2 / (at[4] ** 2 - beside**2)
        return beside - np.sign(beside) * at[4], 1.0

    cost, matrix, vector = 0.0, np.zeros((5, 5)), np.zeros(5)
    for cell in cells:
        found, steep = residual(cell, place)
        steps = 1e-8 * np.eye(5)
        gradient = [(residual(cell, place + step)[0] - residual(cell, place - step)[0]) / 2e-8 for step in steps]
        weight, bound = cell[2] / steep, robust_m**2
        cost += weight * bound * found**2 / (bound + found**2)
        weight *= (bound / (bound + found**2)) ** 2
        matrix += weight * np.outer(gradient, gradient)
        vector -= weight * np.array(gradient) * found
    return cost, matrix, vector


def pair_distance(new, known, settings, gap_max_m):
    """Distances across (M, K) of `fusion.segment_map.pair_distance`, pair by pair; infinite where two do not match."""
    result = np.full((len(new), len(known)), np.inf)
    for m, (start, end) in enumerate(zip(new.start, new.end, strict=True)):
        for k, axis in enumerate(known.direction):
            first, last = ((point - known.start[k]) @ axis for point in (start, end))
            low, high = min(first, last), max(first, last)
            middle = np.mean(np.clip([low, high], 0, known.length[k]))
            at_new = start + np.clip((middle - first) / (last - first), 0, 1) * (end - start)
            across = np.linalg.norm(np.cross(at_new - known.start[k], axis))
            parallel = abs(new.direction[m] @ axis) >= np.cos(settings.angle_max_rad)
            limit_m = settings.distance_max_m + settings.add_radii * (new.radius[m] + known.radius[k])
            if parallel and max(low - known.length[k], -high) <= gap_max_m and across <= limit_m:
                result[m, k] = across
    return result


def bar_equations(ends, start, direction, information, centre, scale_m):
    """Loss, H and b of `odometry.segments.corrections.bar_equations` for ends (P, 2, 3) beside bars, end by end."""
    loss, H, b = 0.0, np.zeros((4, 4)), np.zeros(4)
    for both, at, axis, weight in zip(ends, start, direction, information, strict=True):
        projector = np.eye(3) - np.outer(axis, axis)
        for end in both:
            J = np.column_stack([np.cross([0, 0, 1], end - centre), *np.eye(3)])
            across = projector @ (end - at)
            robust = 1 / (1 + across @ across / scale_m**2)
            loss += 0.5 * weight * across @ across * robust
            H += weight * robust**2 * J.T @ projector @ J
            b += weight * robust**2 * J.T @ across
    return loss, H, b


def ridge_points(mean, weight, voxel_m, radius_m, share_min, contract_m):
    """The rule of `fusion.ridges.ridge_points`: all voxels beside all others."""
    cube = np.floor(mean / voxel_m).astype(int)
    apart = np.linalg.norm(cube[:, None] - cube[None], axis=2) * voxel_m
    most = np.where(apart <= radius_m + 1e-9, weight, 0.0).max(axis=1)
    stay = (weight > 0) & (most * share_min <= weight)
    near = (np.linalg.norm(mean[:, None] - mean[None], axis=2) <= contract_m) & stay
    share = (near * weight)[stay]
    return share @ mean / share.sum(axis=1, keepdims=True)


def world_points(points, T, range_max_m, floor_m):
    """Points in the world, weights 1/range² and indices of those within range and above the floor."""
    world, distance = points @ T[:3, :3].T + T[:3, 3], np.linalg.norm(points, axis=1)
    index = np.flatnonzero((distance > 0) & (distance <= range_max_m) & (world[:, 2] >= floor_m))
    return world[index], 1 / distance[index] ** 2, index


def nearest_bars(points, bars, reach_m, margin_m):
    """The bar nearest to each point, −1 if it is beyond the reach or another one is nearly as near."""
    result = []
    for point in points:
        along = np.clip(((point - bars.start) * bars.direction).sum(axis=1), 0, bars.length)
        distance = np.linalg.norm(point - bars.start - along[:, None] * bars.direction, axis=1)
        nearest, second = sorted([*distance, np.inf])[:2]
        result.append(distance.argmin() if nearest <= reach_m and second - nearest >= margin_m else -1)
    return np.array(result)


def in_bar_frame(point, T, start, direction, across):
    """A point of a scan in the frame of a bar, and the vector from it to the sensor in the same frame."""
    frame, world = np.vstack([across, direction]), T[:3, :3] @ point + T[:3, 3]
    return frame @ (world - start), frame @ (T[:3, 3] - world)


def angle_outline(turn, flange, thickness):
    """Corners (6, 2) of an angle about its centroid, from its two rectangles."""
    f, t = flange, thickness * flange
    corners = np.array([(0, 0), (f, 0), (f, t), (t, t), (t, f), (0, f)])
    centroid = np.average([(f / 2, t / 2), (t / 2, (f + t) / 2)], axis=0, weights=[f * t, (f - t) * t])
    return (corners - centroid) @ Rotation.from_rotvec([0, 0, turn]).as_matrix()[:2, :2].T


def front_face(kind, turn, flange, thickness, towards, beside):
    """Height and slope of an angle, tube or plate of 1 m towards a viewer; −inf where there is none."""
    left = np.array([-towards[1], towards[0]])
    if kind == "tube":
        if abs(beside) >= 0.999 * flange / 2:
            return -np.inf, 0.0
        height = np.sqrt(flange**2 / 4 - beside**2)
        return height, -beside / height
    if kind == "angle":
        outline = angle_outline(turn, flange, thickness)
        edges = [(outline[k - 1], outline[k]) for k in range(6)]
    else:
        half = 0.5 * np.array([-np.sin(turn), np.cos(turn)])
        edges = [(-half, half)] if half @ left > 0 else []
    found = [(-np.inf, 0.0)]
    for a, b in edges:
        if min(a @ left, b @ left) <= beside < max(a @ left, b @ left):
            slope = (b - a) @ towards / ((b - a) @ left)
            found.append((a @ towards + slope * (beside - a @ left), slope))
    return max(found)


def face_residual(place, ray, length, face, sigma_m):
    """Residual along the line of sight across a bar, and its standard deviation; NaN where no face is measured.

    ``place`` and ``ray`` as of `in_bar_frame`; ``face(towards, beside)``: height and slope; ``sigma_m(range)``."""
    distance, range_m = np.linalg.norm(ray[:2]), np.linalg.norm(ray)
    towards = ray[:2] / distance
    height, slope = face(towards, place[1] * towards[0] - place[0] * towards[1])
    grazing = distance**2 < 0.1 * range_m**2 or abs(slope) > 2
    if not 0 <= place[2] <= length or grazing or height == -np.inf:
        return np.nan, np.nan
    residual = place[:2] @ towards - height
    return residual, sigma_m(range_m * (1 + residual / distance)) * distance / range_m


def section_histogram(points, T, bar, bars, across, margin_m, shape, cell_m):
    """The histograms of `sections.histogram.accumulate`, point by point."""
    parts, views, cells, _ = shape
    result = np.zeros((len(bars), *shape))
    for point, b in zip(points, bar, strict=True):
        place, ray = in_bar_frame(point, T, bars.start[b], bars.direction[b], across[b])
        edge = min(margin_m, bars.length[b] / 3)
        square = ray[:2] @ ray[:2]
        towards = ray[:2] / np.sqrt(square)
        cell = int(np.floor((towards[0] * place[1] - towards[1] * place[0]) / cell_m)) + cells // 2
        if not edge <= place[2] <= bars.length[b] - edge or square < 0.1 * ray @ ray or not 0 <= cell < cells:
            continue
        view = int(np.degrees(np.arctan2(ray[1], ray[0]) + np.pi) // (360 / views)) % views
        part = min(parts - 1, int(parts * place[2] / bars.length[b]))
        result[b, part, view, cell] += 1, 1 / square, place[0] / square, place[1] / square
    return result


def section_cells(histogram, length):
    """Cells of a bar with at least three points: means, weight, direction, position along, number of the direction."""
    parts, views = histogram.shape[:2]
    result = []
    for part, view, cell in np.argwhere(histogram[..., 0] >= 3):
        _, weight, u, v = histogram[part, view, cell]
        angle = (view + 0.5) * 2 * np.pi / views - np.pi
        along = ((part + 0.5) / parts - 0.5) * length
        result.append((u / weight, v / weight, weight, np.cos(angle), np.sin(angle), along, view))
    return np.array(result).reshape(-1, 7)


def group_sums(values, group, count):
    return np.array([values[group == g].sum(axis=0) for g in range(count)])


def block_tridiagonal(diagonal, beside):
    """A dense symmetric matrix from its blocks on the diagonal and above it."""
    n, d = diagonal.shape[:2]
    result = np.zeros((n * d, n * d))
    for k in range(n):
        result[k * d : (k + 1) * d, k * d : (k + 1) * d] = diagonal[k]
    for k in range(n - 1):
        result[k * d : (k + 1) * d, (k + 1) * d : (k + 2) * d] = beside[k]
        result[(k + 1) * d : (k + 2) * d, k * d : (k + 1) * d] = beside[k].T
    return result


def integrated(at_s, force, rate, stamp_s, bias):
    """Rotation, velocity and position of readings between stamps, each the mean since the previous reading."""
    result = []
    for begin, end, gyro, accelerometer in zip(stamp_s[:-1], stamp_s[1:], bias[:, :3], bias[:, 3:], strict=True):
        R, v, p = np.eye(3), np.zeros(3), np.zeros(3)
        for i in range(1, len(at_s)):
            passed_s = min(at_s[i], end) - max(at_s[i - 1], begin)
            if passed_s > 0:
                R = R @ Rotation.from_rotvec(passed_s * (rate[i] - gyro)).as_matrix()
                f = R @ (force[i] - accelerometer)
                p = p + passed_s * v + passed_s**2 / 2 * f
                v = v + passed_s * f
        result.append((R, v, p))
    return [np.array(each) for each in zip(*result, strict=True)]


def fill_bundle(T, plane, grid_px, lateral_px, pixel):
    """`simulation.tof_faults.fill_bundle`: rays through displaced points of the image plane."""
    y, z = np.moveaxis(plane + (grid_px[:, None] + lateral_px) * pixel, -1, 0)[..., None]
    T = T[:, None, :3]
    bundle = np.empty((*y.shape[:2], 6), np.float32)
    bundle[..., :3] = T[..., 3]
    bundle[..., 3:] = (T[..., 0] + T[..., 1] * y + T[..., 2] * z) / np.sqrt(1 + y * y + z * z)
    return bundle


def amplitudes(bundle, range_m, normal, reflectivity):
    """`simulation.tof_faults.amplitudes`: Lambert's cosine over the square of the range."""
    cosine = np.abs((normal * bundle[..., 3:]).sum(axis=2, dtype=np.float64))
    return (reflectivity * cosine / range_m**2).astype(np.float32)
