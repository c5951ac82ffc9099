# Triton infers the types of its kernels:
# mypy: disable-error-code="no-untyped-def"
"""Triton kernels: the raster loss by separable blurs, in float32.

A program has ``BLOCK`` pixels of one instance, row after row. Forward, one kernel blurs p, t,
p^2 + t^2 and p t along rows; the next one blurs these along columns, takes SSIM, and writes its
block's sums to a buffer (n, blocks, 7) that no other program writes: no atomics, so two runs give
the same bits. Backward, the blurs are computed again and become the derivatives of SSIM by the
blurred p, p^2 and p t, which are blurred once more (the window is symmetric, so the blur is its own
transpose). Neighbours are read from the cache, once for each of the window's taps.
"""

import torch
import triton
import triton.language as tl

from gsmap.ops.raster_loss.reference import SEEN, SSIM_C1, SSIM_C2

BLOCK = 256
OPTIONS = {"num_warps": 4, "enable_fp_fusion": True}
# A fused a - b * c is the rounding of b * c where it should be 0, as with empty masks.
EXACT_OPTIONS = {**OPTIONS, "enable_fp_fusion": False}
C1, C2 = tl.constexpr(SSIM_C1), tl.constexpr(SSIM_C2)
SEEN_MEAN = tl.constexpr(SEEN)


@triton.jit
def _block(height, width, BLOCK: tl.constexpr):
    """Return a program's instance, the instance's number of pixels, and the block's pixels."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    return tl.program_id(1).to(tl.int64), height * width, index


@triton.jit
def rows_kernel(
    preds, targets, window, maps, height, width, TAPS: tl.constexpr, BLOCK: tl.constexpr
):
    """Blur p, t, p^2 + t^2 and p t (n, H, W) along rows: to maps (n, 4, H, W)."""
    n, pixels, index = _block(height, width, BLOCK)
    col = index % width
    mean_p = tl.zeros((BLOCK,), tl.float32)
    mean_t = tl.zeros((BLOCK,), tl.float32)
    squares = tl.zeros((BLOCK,), tl.float32)
    product = tl.zeros((BLOCK,), tl.float32)
    for tap in tl.static_range(TAPS):
        shift = tap - TAPS // 2
        inside = (index < pixels) & (col + shift >= 0) & (col + shift < width)
        p = tl.load(preds + n * pixels + index + shift, inside, 0.0)
        t = tl.load(targets + n * pixels + index + shift, inside, 0.0)
        weight = tl.load(window + tap)
        mean_p += weight * p
        mean_t += weight * t
        squares += weight * (p * p + t * t)
        product += weight * (p * t)
    out = maps + n * 4 * pixels + index
    tl.store(out, mean_p, index < pixels)
    tl.store(out + pixels, mean_t, index < pixels)
    tl.store(out + 2 * pixels, squares, index < pixels)
    tl.store(out + 3 * pixels, product, index < pixels)


@triton.jit
def _blur_columns(maps, window, index, pixels, width, TAPS: tl.constexpr, BLOCK: tl.constexpr):
    """Blur one map of an instance along columns. (BLOCK,)"""
    total = tl.zeros((BLOCK,), tl.float32)
    for tap in tl.static_range(TAPS):
        place = index + (tap - TAPS // 2) * width
        inside = (index < pixels) & (place >= 0) & (place < pixels)
        total += tl.load(window + tap) * tl.load(maps + place, inside, 0.0)
    return total


@triton.jit
def _ssim_terms(maps, window, n, index, pixels, width, TAPS: tl.constexpr, BLOCK: tl.constexpr):
    """Return the blurred p and t, and SSIM's two numerators and two denominators. (BLOCK,)"""
    own = maps + n * 4 * pixels
    p = _blur_columns(own, window, index, pixels, width, TAPS, BLOCK)
    t = _blur_columns(own + pixels, window, index, pixels, width, TAPS, BLOCK)
    squares = _blur_columns(own + 2 * pixels, window, index, pixels, width, TAPS, BLOCK)
    product = _blur_columns(own + 3 * pixels, window, index, pixels, width, TAPS, BLOCK)
    means = p * p + t * t
    top_cov, low_var = 2 * (product - p * t) + C2, squares - means + C2
    return p, t, 2 * p * t + C1, top_cov, means + C1, low_var


@triton.jit
def sums_kernel(
    preds,
    targets,
    window,
    maps,
    sums,
    weight,
    height,
    width,
    TAPS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Sum a block's share of what `raster_loss_sums_reference` sums: to sums (n, blocks, 7)."""
    n, pixels, index = _block(height, width, BLOCK)
    ok = index < pixels
    mean_p, mean_t, top_mean, top_cov, low_mean, low_var = _ssim_terms(
        maps, window, n, index, pixels, width, TAPS, BLOCK
    )
    low = low_mean * low_var
    dissimilarity = (low - top_mean * top_cov) / low  # exactly 0 where both masks are empty
    p = tl.load(preds + n * pixels + index, ok, 0.0)
    t = tl.load(targets + n * pixels + index, ok, 0.0)
    excess = (weight - 1) * t
    out = sums + (n * tl.num_programs(0) + tl.program_id(0)) * 7
    tl.store(out, tl.sum((1 + excess) * tl.abs(p - t)))
    tl.store(out + 1, tl.sum((1 + excess) * p))
    tl.store(out + 2, tl.sum(tl.where(ok, dissimilarity, 0.0)))
    tl.store(out + 3, tl.sum((1 + excess) * t))
    tl.store(out + 4, tl.sum(excess))
    tl.store(out + 5, tl.sum((ok & (mean_t > 0)).to(tl.float32)))
    either = (mean_p > SEEN_MEAN) | (mean_t > SEEN_MEAN)
    tl.store(out + 6, tl.sum((ok & either).to(tl.float32)))


@triton.jit
def slopes_kernel(window, maps, slopes, height, width, TAPS: tl.constexpr, BLOCK: tl.constexpr):
    """Take SSIM's derivatives by the blurred p, p^2 and p t: to slopes (n, 3, H, W)."""
    n, pixels, index = _block(height, width, BLOCK)
    p, t, top_mean, top_cov, low_mean, low_var = _ssim_terms(
        maps, window, n, index, pixels, width, TAPS, BLOCK
    )
    scale = 1 / (low_mean * low_var)
    ssim = top_mean * top_cov * scale
    change = t * (top_cov - top_mean) + p * ssim * (low_mean - low_var)
    out = slopes + n * 3 * pixels + index
    tl.store(out, 2 * change * scale, index < pixels)
    tl.store(out + pixels, -ssim * scale * low_mean, index < pixels)
    tl.store(out + 2 * pixels, 2 * top_mean * scale, index < pixels)


@triton.jit
def slope_rows_kernel(
    window, slopes, blurred, height, width, TAPS: tl.constexpr, BLOCK: tl.constexpr
):
    """Blur maps (n * 3, H, W) along rows; the grid's second axis is that of the maps."""
    n, pixels, index = _block(height, width, BLOCK)
    col = index % width
    total = tl.zeros((BLOCK,), tl.float32)
    for tap in tl.static_range(TAPS):
        shift = tap - TAPS // 2
        inside = (index < pixels) & (col + shift >= 0) & (col + shift < width)
        slope = tl.load(slopes + n * pixels + index + shift, inside, 0.0)
        total += tl.load(window + tap) * slope
    tl.store(blurred + n * pixels + index, total, index < pixels)


@triton.jit
def gradient_kernel(
    grads,
    preds,
    targets,
    window,
    blurred,
    out,
    weight,
    height,
    width,
    TAPS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Blur slopes along columns, and write the gradient of the sums times grads (n, 7)."""
    n, pixels, index = _block(height, width, BLOCK)
    own = blurred + n * 3 * pixels
    by_mean = _blur_columns(own, window, index, pixels, width, TAPS, BLOCK)
    by_square = _blur_columns(own + pixels, window, index, pixels, width, TAPS, BLOCK)
    by_product = _blur_columns(own + 2 * pixels, window, index, pixels, width, TAPS, BLOCK)
    p = tl.load(preds + n * pixels + index, index < pixels, 0.0)
    t = tl.load(targets + n * pixels + index, index < pixels, 0.0)
    sign = (p > t).to(tl.float32) - (p < t).to(tl.float32)
    slope = tl.load(grads + n * 7) * sign + tl.load(grads + n * 7 + 1)
    ssim = by_mean + 2 * p * by_square + t * by_product
    total = (1 + (weight - 1) * t) * slope - tl.load(grads + n * 7 + 2) * ssim
    tl.store(out + n * pixels + index, total, index < pixels)


def _blur_products(preds, targets, window):
    """Return the products' blurs along rows (n, 4, H, W), and the grid of the blocks."""
    instances, height, width = preds.shape
    maps = torch.empty(instances, 4, height, width, dtype=torch.float32, device=preds.device)
    grid = triton.cdiv(height * width, BLOCK), instances
    rows_kernel[grid](
        preds, targets, window, maps, height, width, TAPS=len(window), BLOCK=BLOCK, **OPTIONS
    )
    return maps, grid


def raster_loss_sums(preds, targets, window, weight):
    """Return the sums of `raster_loss_sums_reference`; the first three are differentiable."""
    if not preds.numel():
        return preds.new_zeros(len(preds), 7)
    preds, targets = preds.contiguous(), targets.contiguous()
    height, width = preds.shape[1:]
    with torch.cuda.device_of(preds):
        maps, grid = _blur_products(preds, targets, window)
        sums = torch.empty(len(preds), grid[0], 7, dtype=torch.float32, device=preds.device)
        tensors = preds, targets, window, maps, sums
        sizes = {"TAPS": len(window), "BLOCK": BLOCK, **EXACT_OPTIONS}
        sums_kernel[grid](*tensors, weight, height, width, **sizes)
    return sums.sum(1)


def raster_loss_sums_backward(grads, preds, targets, window, weight):
    """Return the gradient in the predictions. (n, H, W)"""
    preds, targets = preds.contiguous(), targets.contiguous()
    gradient = torch.empty_like(preds)
    if not preds.numel():
        return (gradient,)
    instances, height, width = preds.shape
    sizes = {"TAPS": len(window), "BLOCK": BLOCK, **OPTIONS}
    slopes = torch.empty(instances, 3, height, width, dtype=torch.float32, device=preds.device)
    with torch.cuda.device_of(preds):
        maps, grid = _blur_products(preds, targets, window)
        slopes_kernel[grid](window, maps, slopes, height, width, **sizes)
        blurred = maps.view(-1)[: slopes.numel()]  # the maps are not needed any more
        slope_rows_kernel[grid[0], 3 * instances](window, slopes, blurred, height, width, **sizes)
        tensors = grads.contiguous(), preds, targets, window, blurred, gradient
        gradient_kernel[grid](*tensors, weight, height, width, **sizes)
    return (gradient,)
