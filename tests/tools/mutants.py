# ruff: noqa: E501 - lines of kernels
"""Small faults for the kernels, by hand: what is put in place of what, and which tests should notice.

An anchor has to occur in its file exactly once. When a kernel changes, :mod:`tests.tools.mutate` refuses to run until the
anchor follows: a list that silently shrinks proves nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["MUTANTS", "SUITES", "WIDE", "Mutant"]


@dataclass(frozen=True)
class Mutant:
    """One fault.

    Parameters
    ----------
    file : str
        In ``cldof/kernels``.
    old, new : str
        Text that occurs once, and what replaces it.
    kind : str
        ``"sign"``, ``"clamp"``, ``"off by one"``, ``"swap"``, ``"compare"``, ``"index"``, ``"weight"``, ``"drop"`` or
        ``"call"``.
    """

    file: str
    old: str
    new: str
    kind: str

    @property
    def name(self) -> str:
        """For people: file, kind and the text that is gone."""
        old, new = (" ".join(text.split()) for text in (self.old, self.new))
        return f"{self.file} ({self.kind}): {old} -> {new or 'nothing'}"


# What of the suite is run first, by kernel file: the tests that know that file best, without slow ones.
SUITES: dict[str, list[list[str]]] = {
    "blur.cl": [["tests/kernels/test_blur.py", "-k", "not full_hd and not 200 and not 120"]],
    "frame.cl": [
        ["tests/kernels/test_frame.py", "tests/test_renderer.py", "-k", "inverse or supersampling or middles"]
    ],
    "frame.clh": [["tests/kernels/test_frame.py", "tests/planner/test_stats.py"]],
    "gather.cl": [["tests/kernels/test_gather.py", "tests/methods/test_gather.py"]],
    "layered.cl": [["tests/methods/test_layered.py"]],
    "lightfield.cl": [
        ["tests/kernels/test_lightfield.py"],
        ["tests/methods/test_lightfield.py"],
        ["tests/planner/test_ablation.py::test_scattered_tiles"],
    ],
    "multiview.cl": [
        ["tests/kernels/test_multiview.py"],
        ["tests/methods/test_multiview.py", "-k", "not dense_marching and not dense_sampling"],
    ],
    "pyramid.cl": [["tests/kernels/test_pyramid.py"], ["tests/methods/test_pyramid.py", "-k", "not scenes"]],
    "slots.clh": [["tests/methods/test_layered.py"], ["tests/kernels/test_pyramid.py"]],
    "stats.cl": [["tests/planner/test_stats.py", "tests/kernels/test_frame.py"], ["tests/test_portable_kernels.py"]],
    "plan.cl": [
        ["tests/planner/test_ablation.py"],
        ["tests/test_every_kernel.py", "-k", "sharp"],
        ["tests/planner/test_plan.py", "tests/test_renderer.py"],
    ],
    "shading.cl": [["tests/kernels/test_shading.py", "tests/methods/test_view_dependent.py"]],
    "shading.clh": [["tests/kernels/test_shading.py", "tests/methods/test_view_dependent.py"]],
    "common.clh": [
        ["tests/kernels/test_gather.py", "tests/methods/test_layered.py"],
        ["tests/kernels/test_pyramid.py"],
    ],
    "fir.clh": [["tests/kernels/test_blur.py", "-k", "fir"], ["tests/methods/test_layered.py"]],
}

# What is run for those that survive.
WIDE: list[list[str]] = [
    ["tests/methods/test_promises.py", "tests/test_renderer.py"],
    ["tests/methods", "-k", "reference or dense_marching"],
]


def _rows(file: str, *rows: tuple[str, str, str]) -> list[Mutant]:
    return [Mutant(file, old, new, kind) for kind, old, new in rows]


MUTANTS: list[Mutant] = [
    *_rows(
        "common.clh",
        ("drop", "n > 2 ? load_pixel(p + 8) : none, none);", "none, none);"),
        ("sign", "front + (1.0f - front.ALPHAS) * back", "front + (1.0f + front.ALPHAS) * back"),
        ("swap", "(v.xxxx, v.yyyy, v.zzzz, v.wwww)", "(v.xxxx, v.zzzz, v.yyyy, v.wwww)"),
        ("clamp", "return v > 1.0f ? (floatn)(1.0f) : v;", "return v;"),
        ("clamp", "    return i > last ? last : i;", "    return i > last ? last - (last > 0) : i;"),
    ),
    *_rows(
        "fir.clh",
        ("off by one", "first -= (count) * (step);", "first -= (count) * (step) + 4;"),
        ("clamp", "clamp_index(y + i + t, height - 1)", "clamp_index(y + i + t, height - 2)"),
        ("swap", "int from = (x < 0 ? 0 : width - 1) - first;", "int from = (x < 0 ? width - 1 : 0) - first;"),
        ("off by one", "last = first + (step);", "last = first;"),
        ("off by one", "if (radius & 2) FIR_TAPS(2, load, step)", ""),
    ),
    *_rows(
        "blur.cl",
        ("off by one", "const __global float *centre = taps + FIR_PAD + radius;",
         "const __global float *centre = taps + FIR_PAD + radius - 1;"),
        ("sign", "(x - k[i].pole_im * s->im[i])", "(x + k[i].pole_im * s->im[i])"),
        ("sign", "y += k[i].gain_re * s->re[i] - k[i].gain_im * s->im[i];",
         "y += k[i].gain_re * s->re[i] + k[i].gain_im * s->im[i];"),
        ("drop", "iir_rest(&s, sections, load_lanes(from + (height - 1) * stride));", ""),
        ("index", "iir_rest(&s, sections, load_rows(from, width - 1));", "iir_rest(&s, sections, load_rows(from, 0));"),
        ("off by one", "for (int y = height - 1; y >= 0; y--)", "for (int y = height - 1; y > 0; y--)"),
    ),
    *_rows(
        "frame.cl",
        ("off by one", "inverse_run(z + x, rgba + 4 * x, width - x, nothing)",
         "inverse_run(z + x, rgba + 4 * x, width - x + 1, nothing)"),
        ("weight", "1.0f / (float)(factor * factor)", "1.0f / (float)(factor)"),
        ("off by one", "for (int i = 0; i < factor; i++) sum", "for (int i = 1; i < factor; i++) sum"),
        ("off by one", "((size_t)y * factor + factor / 2) * stride", "((size_t)y * factor + factor / 2 - 1) * stride"),
    ),
    *_rows(
        "frame.clh",
        ("compare", "return there > 0.0f || rgba.w > 0.0f", "return there > 0.0f || rgba.w >= 0.0f"),
        ("compare", "return there > 0.0f || alpha > 0.0f", "return there > 0.0f || alpha >= 0.0f"),
        ("drop", "there = CHANNEL_OF(c, RED) + CHANNEL_OF(c, GREEN) +",
         "there = CHANNEL_OF(c, RED) +"),
        ("clamp", "load_pixel(color + 4 * i), nothing) : EMPTY;", "load_pixel(color + 4 * i), nothing) : nothing;"),
    ),
    *_rows(
        "gather.cl",
        ("sign", "values_at(flat_inv + row, x, end, is_whole) + c0;", "values_at(flat_inv + row, x, end, is_whole) - c0;"),
        ("compare", "weight *= theirs > coc ?", "weight *= theirs < coc ?"),
        ("drop", "weights > 0.0f ? sum[q] / weights : own", "weights > 0.0f ? sum[q] : own"),
        ("off by one", "pixels_at(flat + there * 4, at + PIXELS * q, end, is_inside)", "pixels_at(flat + there * 4, at + 1 + PIXELS * q, end, is_inside)"),
        ("clamp", "lesser(greater(reach, zero), one);", ""),
        ("clamp", "lesser((floatn)(tap.distance), radius);", "tap.distance;"),
        ("drop", "step = step == now ? (intn)(-1) : step;", "step = (intn)(-1);"),
        ("swap", "+ part * tap.change;", "+ mine * tap.change;"),
        ("weight", "lesser(absolute(coc), (floatn)(last));", "lesser(absolute(coc), (floatn)(0.5f * last));"),
    ),
    *_rows(
        "slots.clh",
        ("drop", "to_b = b < 0.0f || to_b > silhouette ? (floatn)(MAXFLOAT) : to_b;", ""),
        ("clamp", "to_a = a < 0.0f || to_a > silhouette ?", "to_a = a < 0.0f ?"),
        ("off by one", "floatn left = x > 0 ? load_lanes(inv - 1)", "floatn left = x > 0 ? load_lanes(inv - 2)"),
        ("compare", "return across > down ? across : down;", "return across < down ? across : down;"),
        ("sign", "x + dx[i], y + dy[i],", "x + dx[i], y - dy[i],"),
        ("drop", "const floatn beyond = w + 1.0f / scale;", "const floatn beyond = w;"),
        ("weight", "clamp01(1.0f - (w - a - b_nearer) * scale)", "clamp01(1.0f - (w - a - b_nearer) * 4.0f * scale)"),
        ("weight", "return found * 0.125f;", "return found * 0.25f;"),
    ),
    *_rows(
        "layered.cl",
        ("swap", "k > 0 ? matting->layer[k - 1] : (float4)(0.0f)", "matting->layer[k]"),
        ("compare", "floatn at_once = falling >= 1.0f ?", "floatn at_once = falling > 0.0f ?"),
        ("sign", "up = clamp01((rising - 1.0f) / part + 1.0f);", "up = clamp01((rising - 1.0f) / part - 1.0f);"),
        ("weight", "floatn others = 1.0f - rest *", "floatn others = 1.0f + rest *"),
        ("drop", "return w < 0.0f ? zero : up * down;", "return up * down;"),
        ("swap", "c.ALPHA = is_last ? (floatp)(1.0f) : a;", "c.ALPHA = is_last ? a : (floatp)(1.0f);"),
        ("sign", "floatp rest = 1.0f - (1.0f - t) * alpha;", "floatp rest = 1.0f - t * alpha;"),
        ("swap", "v = in_front ? over(v, layer)", "v = !in_front ? over(v, layer)"),
        ("compare", ">= (float)(PIXELS * FIR_ROWS);", ">= 0.5f * (float)(PIXELS * FIR_ROWS);"),
        ("drop", "any |= reached[r * size.tiles_x + tx]", "any = reached[r * size.tiles_x + tx]"),
        ("compare", "nearest = w > nearest ? w : nearest;", "nearest = w < nearest ? w : nearest;"),
        ("index", "|= 1u << m;", "|= 2u << m;"),
        ("drop", "floatp scale = coverage > LAYERED_MIN_COVERAGE ? 1.0f / coverage : (floatp)(0.0f);",
         "floatp scale = coverage > LAYERED_MIN_COVERAGE ? (floatp)(1.0f) : (floatp)(0.0f);"),
        ("swap", "first ? acc[i] : over(load_lanes(to), acc[i])", "first ? acc[i] : over(acc[i], load_lanes(to))"),
    ),
    *_rows(
        "pyramid.cl",
        ("index", "for (int m = source; m < size.peels; m++)", "for (int m = 0; m < size.peels; m++)"),
        ("compare", "alpha >= 0.5f ? w : depth;", "alpha > 0.5f ? w : depth;"),
        ("sign", "image += (1.0f - image.ALPHAS) * c;", "image += c;"),
        ("clamp", "needed = needed > 1.0f ? one : needed;", ""),
        ("swap", "return clamp01(matting_axis(w) * ramp.z + ramp.w);", "return clamp01(matting_axis(w) * ramp.x + ramp.y);"),
        ("compare", "take = open && rise_of(w, s, at, slope, broad, ramps) > 0.0f;", "take = open && rise_of(w, s, at, slope, broad, ramps) >= 0.0f;"),
        ("weight", "float4 scale = count > 0.0f ? 1.0f / count : (float4)(0.0f);", "float4 scale = count > 0.0f ? (float4)(0.25f) : (float4)(0.0f);"),
        ("off by one", "fine_row & 1 ? near + 1 : near - 1", "fine_row & 1 ? near : near - 1"),
        ("swap", "fine.even = 0.75f * mid + 0.25f * left;", "fine.even = 0.75f * mid + 0.25f * right;"),
        ("off by one", "clamp_index(2 * row - 1, sub.w - 1) - sub.x", "clamp_index(2 * row - 2, sub.w - 1) - sub.x"),
        ("off by one", "clamp_index(2 * x - 1 + 4 * t + j, sub.z - 1)", "clamp_index(2 * x - 1 + 4 * t + j, sub.z - 2)"),
        ("off by one", "clamp_index(2 * row - 1 + j, fine.z - 1)", "clamp_index(2 * row + j, fine.z - 1)"),
        ("weight", "store_lanes(blur + ((size_t)coarse.x + (size_t)row * coarse.w + x) * 4, 0.0625f *",
         "store_lanes(blur + ((size_t)coarse.x + (size_t)row * coarse.w + x) * 4, 0.0630f *"),
        ("drop", "w < 0.0f ? expand_depth(fill_inv, rows, x / 2) : w);", "expand_depth(fill_inv, rows, x / 2));"),
        ("drop", "floatp scale = coverage > PYRAMID_MIN_COVERAGE ? 1.0f / coverage : (floatp)(0.0f);",
         "floatp scale = coverage > PYRAMID_MIN_COVERAGE ? (floatp)(1.0f) : (floatp)(0.0f);"),
        ("sign", "sum[q] += (1.0f - sum[q].ALPHAS) * quad[q];", "sum[q] += (1.0f + sum[q].ALPHAS) * quad[q];"),
    ),
    *_rows(
        "multiview.cl",
        ("sign", "floatn c = steps.anchor - w,", "floatn c = steps.anchor + w,"),
        ("compare", "least = px_a < px_b ? to_a : to_b;", "least = px_a > px_b ? to_a : to_b;"),
        ("drop", "return (a_joins | b_joins) & ~sticks_out ? least", "return (a_joins | b_joins) ? least"),
        ("off by one", "step = 1 << (level - 1);", "step = 1 << level;"),
        ("off by one", "const int x0 = cx * MULTIVIEW_SCALE - reach,", "const int x0 = cx * MULTIVIEW_SCALE + reach,"),
        ("swap", "floatp weight = v.ALPHA >= MULTIVIEW_OPAQUE ? ins[q] : owns[q];", "floatp weight = ins[q];"),
        ("sign", "middle + share * (total / weight - middle) : middle;", "middle : middle;"),
        ("swap", "(float2)(places->bound[s], places->bound[s + 1]) * c1 + c0;", "(float2)(places->bound[s + 1], places->bound[s]) * c1 + c0;"),
        ("compare", "if (known <= least) return pinhole", "if (known < 0.0f) return pinhole"),
        ("drop", "quad[q] += v * spread((1.0f - covered) * weight);", "quad[q] += v * spread(weight);"),
        ("weight", "const float weight = t < 0 || t == taps ? edge : 1.0f;", "const float weight = 1.0f;"),
        ("off by one", "floatn sum = edge * (load_lanes_private(at - 4) +", "floatn sum = edge * (load_lanes_private(at) +"),
        ("clamp", "inside = clamp_index(x, fine.width - 1);", "inside = clamp_index(x, fine.width - 2);"),
        ("drop", "v = front + (1.0f - front.w) * v;", "v = front + v;"),
        ("sign", "const int x = x0 + by.x, row = y + by.y;", "const int x = x0 - by.x, row = y + by.y;"),
        ("drop", "alpha < 0.0f ? (floatn)(0.0f) : share * v[q];", "share * v[q];"),
        ("sign", "const __global float *side = at + 4 * over,", "const __global float *side = at - 4 * over,"),
        ("swap", "const __global float *corner = next + 4 * over;", "const __global float *corner = next;"),
        ("off by one", "const int rim = is_between ? 1 : 0;", "const int rim = 0;"),
        ("sign", "past < 0.0f ? -share : share;", "share;"),
        ("weight", "return share <= 0.0f ? 0.0f :", "return share <= 0.1f ? 0.0f :"),
        ("drop", "float4 v = sum / known;", "float4 v = sum;"),
        ("compare", "past += through > MULTIVIEW_CLOSED || alpha == 0.0f ?", "past += through > MULTIVIEW_CLOSED ?"),
    ),
    *_rows(
        "stats.cl",
        ("swap", "const floatn low = w < other ? w : other, high = w < other ? other : w;", "const floatn low = w < other ? other : w, high = w < other ? w : other;"),
        ("clamp", "bin = bin > (float)(STATS_BINS - 1) ? (floatn)(STATS_BINS - 1) : bin;", ""),
        ("compare", "const intn there = (w >= 0.0f) & (alpha > 0.0f);\n            const floatn is", "const intn there = (w >= 0.0f) & (alpha >= 0.0f);\n            const floatn is"),
        ("weight", "0.2126f * rgb.x + 0.7152f * rgb.y", "0.7152f * rgb.x + 0.2126f * rgb.y"),
        ("drop", "if (y0 + rows < size.height) {", "if (0) {"),
        ("drop", "        above = w;", ""),
        ("off by one", "const float next = n - r > LANES", "const float next = n - r > LANES + 1"),
        ("drop", "if (tx == size.tiles_x - 1)", "if (0)"),
        ("weight", "tile.slots = tile.solid = (float)(rows * STATS_TILE);", "tile.slots = tile.solid = (float)(STATS_TILE * STATS_TILE);"),
        ("compare", "solid += alpha >= 1.0f ? is : zero;", "solid += is;"),
        ("swap", "tile.low[0] = low4.x, tile.low[1] = low4.y", "tile.low[0] = low4.y, tile.low[1] = low4.x"),
        ("off by one", "int y = STATS_TILE * ty + (5 * ty) % STATS_TILE;", "int y = STATS_TILE * ty + (5 * ty + 1) % STATS_TILE;"),
        ("clamp", "y = y < size.height ? y : size.height - 1;", ""),
        ("compare", "if (!(w >= 0.0f && rgba[4 * x + 3] > 0.0f)) continue;", "if (!(w >= 0.0f)) continue;"),
        # No picture changes; drivers that compile without AVX-512 end the process.
        ("call", "    return to_uintn(bin);", "#if LANES == 16\n    return convert_uint16(bin);\n#else\n    return to_uintn(bin);\n#endif"),
    ),
    *_rows(
        "plan.cl",
        ("swap", "image = m == peels - 1 ? c : over(c, image);", "image = m == peels - 1 ? c : over(image, c);"),
        ("off by one", "(((size_t)m * height + window.y + y) * pitch + window.x) * channels", "(((size_t)m * height + window.y + y) * pitch + window.x + 1) * channels"),
        ("off by one", "const int first = window.x0 > guard ? window.x0 : guard;", "const int first = window.x0 > guard ? window.x0 + 1 : guard;"),
        ("index", "(y - guard) * out_width + first - guard) * 4;", "(y - guard) * out_width + first) * 4;"),
        ("compare", "if (peels > 1 && least_lane(image.ALPHAS) != 1.0f", "if (peels > 1 && least_lane(image.ALPHAS) < 0.5f"),
        ("off by one", "for (; i < window_pitch * channels; i++) target[i] = fill;", "for (i++; i < window_pitch * channels; i++) target[i] = fill;"),
        ("index", "(size_t)row * window_width + first - window.x) * 4;", "(size_t)row * window_width + first) * 4;"),
        ("clamp", "const int end = window.x1 < width - guard ? window.x1 : width - guard;", "const int end = window.x1;"),
    ),
    *_rows(
        "shading.cl",
        ("drop", "n = shading_3(n.x * scale, n.y * scale, n.z * scale);", ""),
        ("sign", "floatn rest = c - c.ALPHAS * shading_pixels(light, q);", "floatn rest = c + c.ALPHAS * shading_pixels(light, q);"),
        ("index", "load_lanes(p + 6 * plane)", "load_lanes(p + 5 * plane)"),
        ("swap", "shading_eye(lighting, right * radius, up * radius)", "shading_eye(lighting, up * radius, right * radius)"),
        ("clamp", "rest > 0.0f ? rest : (floatn)(0.0f)", "rest"),
        ("index", "shading_every(specular + 3 * at + 1, 3, count)", "shading_every(specular + 3 * at, 3, count)"),
        ("sign", "c + c.ALPHAS * shading_pixels(light, q), valid", "c - c.ALPHAS * shading_pixels(light, q), valid"),
        ("swap", "load_lanes(p + 3 * plane), load_lanes(p + 4 * plane)", "load_lanes(p + 4 * plane), load_lanes(p + 3 * plane)"),
    ),
    *_rows(
        "shading.clh",
        ("sign", "above = (view.z - y) * (1.0f / view.x) * z;", "above = (y - view.z) * (1.0f / view.x) * z;"),
        ("weight", "return shading_above(alpha * shading_rsqrt(alpha), 0.08f);", "return shading_above(alpha, 0.08f);"),
        ("clamp", "    return v < 1.0f ? v : (floatn)(1.0f);", "    return v;"),
        ("weight", "strength *= t * t * (3.0f - 2.0f * t);", "strength *= t;"),
        ("weight", "k = 0.5f * rough * rough;", "k = rough * rough;"),
        ("sign", "d.x * sum + (d.x < 0.0f ? -fold : fold)", "d.x * sum + fold"),
        ("clamp", "sharper < 0 ? 0 : sharper > 4 ? 4 : sharper;", "sharper < 0 ? 0 : sharper > 3 ? 3 : sharper;"),
        ("off by one", "SHADING_STARTS[level] + j * (side + 2) + i;", "SHADING_STARTS[level] + j * (side + 1) + i;"),
        ("weight", "f5 = f5 * (f5 * f5) * (f5 * f5);", "f5 = f5 * f5;"),
        ("clamp", "strength = square_m > 1e-6f ? inverse * inverse : (floatn)(1e6f);", "strength = inverse * inverse;"),
        ("compare", "shading_dot(normal, normal) > 0.0f ?", "shading_dot(normal, normal) >= 0.0f ?"),
        ("sign", "0.5f + 0.5f * d.y", "0.5f - 0.5f * d.y"),
    ),
    *_rows(
        "lightfield.cl",
        ("swap", "return bits & 0x80000000u ? bits : ~(bits | 0x80000000u);", "return bits & 0x80000000u ? ~bits : bits | 0x80000000u;"),
        ("clamp", "if (absolute_of(d) > STEEP_PX) return MAXFLOAT;", ""),
        ("compare", "e) < absolute_of(best) ? e : best;", "e) > absolute_of(best) ? e : best;"),
        ("sign", "(d < 0.0f ? -0.5f : 0.5f)", "(d < 0.0f ? 0.5f : 0.5f)"),
        ("compare", "is_closed = other.y >= 0.0f && other.x > own.y;", "is_closed = other.y >= 0.0f;"),
        ("drop", "(front.y - own.x) + 3.0f <=", "(front.y - own.x) * 0.25f <="),
        ("off by one", "first = ((at) + 128) >> 8;", "first = ((at) + 255) >> 8;"),
        ("off by one", "end = ((at) + 511) >> 8;", "end = ((at) + 255) >> 8;"),
        ("drop", "#define EDGE_OVERLAP 8 ", "#define EDGE_OVERLAP (-8) "),
        ("sign", "EDGE_REACH(l, -TO_INT(", "EDGE_REACH(l, TO_INT("),
        ("drop", "if (to[1] == key) atomic_min(to, at);", "if (to[1] == key) *to = at;"),
        ("compare", "return other >= 0.0f && absolute_of(lens.c1)", "return absolute_of(lens.c1)"),
        ("drop", "return LIGHTFIELD_GLASS == 0 || (a.w >= OPAQUE_ALPHA)", "return 1 || (a.w >= OPAQUE_ALPHA)"),
        ("sign", "int step_x = ray_x < x << 8 ? -1 : 1,", "int step_x = ray_x < x << 8 ? 1 : -1,"),
        ("weight", "const float weight = (i ? 0.25f : 0.5f) * (j ? 0.25f : 0.5f);", "const float weight = 0.25f;"),
        ("sign", "const intn ray_y = top - to_intn(c * shift_y);", "const intn ray_y = top + to_intn(c * shift_y);"),
        ("index", "q = load_pixel(corner + size.width * 4);", "q = load_pixel(corner + size.width * 4 + 4);"),
        ("weight", "const float weight = 1.0f / (tangent * tangent);", "const float weight = 1.0f / tangent;"),
        ("swap", "return a.y < b.y || (a.y == b.y && a.x < b.x);", "return a.y > b.y || (a.y == b.y && a.x < b.x);"),
        ("weight", "? weight : weight * ray.w;", "? weight : weight;"),
        ("drop", "&& !(LIGHTFIELD_GLASS > 0 && is_glass(color, size, m - 1, x, y)))", ")"),
        ("compare", "if (inv_depth[row * size.pitch + at_x] > w + t &&", "if (inv_depth[row * size.pitch + at_x] > w &&"),
        ("sign", "const float to_x = -lens.c1 * v_x, to_y = -lens.c1 * v_y;", "const float to_x = lens.c1 * v_x, to_y = -lens.c1 * v_y;"),
        ("drop", "&& color[(row * size.width + at_x) * 4 + 3] >= OPAQUE_ALPHA)", ")"),
        ("clamp", "    t = t < 0.0f ? 0.0f : t;\n    if (!(t < 1e12f)) return 0;", "    if (!(t < 1e12f)) return 0;"),
        ("off by one", "for (int t = x0 / GAP_TILE; t * GAP_TILE < x1; t++)", "for (int t = x0 / GAP_TILE; t * GAP_TILE < x0; t++)"),
        ("weight", "#define FOOTPRINT_PX 7.0f", "#define FOOTPRINT_PX (-2.0f)"),
        ("drop", "if (row_gaps[(x0 + i + size.guard) / GAP_TILE] != 0) continue;", ""),
    ),
]  # fmt: skip
