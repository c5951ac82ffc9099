# Functions of Triton have no types, since Triton infers them.
# mypy: disable-error-code="no-untyped-def"
"""Triton kernels of the raster loss, with separable blurs, in float32.

In this file, p is the predicted mask and t is the ground-truth mask of one of n instances. A
program computes ``BLOCK`` consecutive pixels of one instance. All kernels but `slope_rows_kernel`
have the grid of programs (blocks, n). In the forward pass, the first kernel blurs p, t, p^2 + t^2
and p t along rows. The second kernel blurs them along columns, computes SSIM, and writes the
seven sums of `raster_loss_sums` over its block to separate entries of a buffer (n, blocks, 7).
There are no atomics, so repeated runs give bitwise equal results.

SSIM needs the variances of p and t only as their sum, so one map of the blurred p^2 + t^2 replaces
two maps. It is enough for the gradient as well: SSIM depends on p^2 only by this sum, so its
derivative with respect to the blurred p^2 is its derivative with respect to the blurred sum.

The backward pass computes the blurs again and, from them, the derivatives of SSIM with respect to
the blurred p, p^2 and p t. The gradient with respect to a map before its blur is the transposed
blur of the derivative. As the window is symmetric, the transposed blur equals the blur, so the
derivatives are blurred once more.

For each pixel and each tap (weight of the window), a kernel loads one neighbour from memory. The
windows of adjacent pixels overlap, so the cache serves most of these loads.
"""

import torch
import triton
import triton.language as tl

from gsmap.ops.raster_loss.reference import MIN_COVERAGE, SSIM_C1, SSIM_C2

BLOCK = 256  # pixels of a program
OPTIONS = {"num_warps": 4, "enable_fp_fusion": True}
# Where both masks are empty, numerator and denominator of SSIM are equal products, and their
# difference must be exactly 0. A fused multiply-add would subtract an unrounded product from a
# rounded product, so that the rounding error would remain.
EXACT_OPTIONS = {**OPTIONS, "enable_fp_fusion": False}
# Kernels can read global values only if they are `tl.constexpr`.
C1 = tl.constexpr(SSIM_C1)
C2 = tl.constexpr(SSIM_C2)
COVERAGE = tl.constexpr(MIN_COVERAGE)


@triton.jit
def _block(height, width, BLOCK: tl.constexpr):
    """Return a program's instance, the number of pixels per instance, and the block's pixels.

    The last block of an instance may have indices of pixels beyond the instance.
    """
    n = tl.program_id(1).to(tl.int64)  # offsets such as n * 4 * pixels may exceed 32 bits
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    return n, height * width, index


@triton.jit
def rows_kernel(
    preds, targets, window, maps, height, width, TAPS: tl.constexpr, BLOCK: tl.constexpr
):
    """Blur p, t, p^2 + t^2 and p t along rows.

    Args:
        preds: Predicted masks p in [0, 1], float32. (n, H, W)
        targets: Ground-truth masks t in [0, 1], float32. (n, H, W)
        window: Weights of SSIM's window, float32. (TAPS,)
        maps: Output for the blurred p, t, p^2 + t^2 and p t, float32. (n, 4, H, W)
        height: Rows H of the masks.
        width: Columns W of the masks.
        TAPS: Size of the window.
        BLOCK: Number of pixels of a program.
    """
    n, pixels, index = _block(height, width, BLOCK=BLOCK)
    col = index % width  # a tap beyond the left or right edge would be in another row
    mean_p = tl.zeros((BLOCK,), dtype=tl.float32)
    mean_t = tl.zeros((BLOCK,), dtype=tl.float32)
    squares = tl.zeros((BLOCK,), dtype=tl.float32)
    product = tl.zeros((BLOCK,), dtype=tl.float32)
    for tap in tl.static_range(TAPS):
        shift = tap - TAPS // 2  # from the centre of the window
        inside = (index < pixels) & (col + shift >= 0) & (col + shift < width)
        p = tl.load(preds + n * pixels + index + shift, mask=inside, other=0.0)
        t = tl.load(targets + n * pixels + index + shift, mask=inside, other=0.0)
        weight = tl.load(window + tap)
        mean_p += weight * p
        mean_t += weight * t
        squares += weight * (p * p + t * t)
        product += weight * (p * t)
    out = maps + n * 4 * pixels + index
    tl.store(out, mean_p, mask=index < pixels)
    tl.store(out + pixels, mean_t, mask=index < pixels)
    tl.store(out + 2 * pixels, squares, mask=index < pixels)
    tl.store(out + 3 * pixels, product, mask=index < pixels)


@triton.jit
def _blur_columns(maps, window, index, pixels, width, TAPS: tl.constexpr, BLOCK: tl.constexpr):
    """Blur one map of an instance along columns, with zeros outside of the map. (BLOCK,)"""
    total = tl.zeros((BLOCK,), dtype=tl.float32)
    for tap in tl.static_range(TAPS):
        neighbour = index + (tap - TAPS // 2) * width
        inside = (index < pixels) & (neighbour >= 0) & (neighbour < pixels)
        total += tl.load(window + tap) * tl.load(maps + neighbour, mask=inside, other=0.0)
    return total


@triton.jit
def _ssim_terms(maps, window, n, index, pixels, width, TAPS: tl.constexpr, BLOCK: tl.constexpr):
    """Compute the blurred p and t, and the terms of SSIM at the pixels of a block.

    Returns:
        Blurred p, blurred t, the two factors of SSIM's numerator (from means, from the covariance),
        and the two factors of its denominator (from means, from variances). (BLOCK,) each
    """
    map_p = maps + n * 4 * pixels
    map_t = map_p + pixels
    map_squares = map_p + 2 * pixels
    map_product = map_p + 3 * pixels
    mean_p = _blur_columns(
        map_p, window, index=index, pixels=pixels, width=width, TAPS=TAPS, BLOCK=BLOCK
    )
    mean_t = _blur_columns(
        map_t, window, index=index, pixels=pixels, width=width, TAPS=TAPS, BLOCK=BLOCK
    )
    squares = _blur_columns(
        map_squares, window, index=index, pixels=pixels, width=width, TAPS=TAPS, BLOCK=BLOCK
    )
    product = _blur_columns(
        map_product, window, index=index, pixels=pixels, width=width, TAPS=TAPS, BLOCK=BLOCK
    )
    square_means = mean_p * mean_p + mean_t * mean_t
    top_mean = 2 * mean_p * mean_t + C1
    top_cov = 2 * (product - mean_p * mean_t) + C2
    low_mean = square_means + C1
    low_var = squares - square_means + C2  # the sum of both variances, plus C2
    return mean_p, mean_t, top_mean, top_cov, low_mean, low_var


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
    """Compute the sums of `raster_loss_sums_reference` over one block of pixels.

    Args:
        preds: Predicted masks p in [0, 1], float32. (n, H, W)
        targets: Ground-truth masks t in [0, 1], float32. (n, H, W)
        window: Weights of SSIM's window, float32. (TAPS,)
        maps: Result of `rows_kernel`: p, t, p^2 + t^2 and p t, blurred along rows, float32.
            (n, 4, H, W)
        sums: Output for the sums, float32. (n, blocks, 7)
        weight: Weight of a foreground pixel, relative to a background pixel.
        height: Rows H of the masks.
        width: Columns W of the masks.
        TAPS: Size of the window.
        BLOCK: Number of pixels of a program.
    """
    n, pixels, index = _block(height, width, BLOCK=BLOCK)
    inside = index < pixels  # pixels beyond the instance add nothing to the sums
    mean_p, mean_t, top_mean, top_cov, low_mean, low_var = _ssim_terms(
        maps, window, n=n, index=index, pixels=pixels, width=width, TAPS=TAPS, BLOCK=BLOCK
    )
    low = low_mean * low_var  # denominator of SSIM
    dissimilarity = (low - top_mean * top_cov) / low  # exactly 0 where both masks are empty
    p = tl.load(preds + n * pixels + index, mask=inside, other=0.0)
    t = tl.load(targets + n * pixels + index, mask=inside, other=0.0)
    excess = (weight - 1) * t
    # The weight of a pixel is w = 1 + excess. Beyond the instance, p and t are 0, so sums of them
    # need no mask. The sums are in the order of the reference: w |p - t|, w p, 1 - SSIM, w t,
    # w - 1, the number of windows with part of the target, and the number of windows with part of
    # either mask. Each pixel has the window around it. A blurred mask is above 0 at a pixel if a
    # part of the mask is in this window.
    out = sums + (n * tl.num_programs(0) + tl.program_id(0)) * 7
    tl.store(out, tl.sum((1 + excess) * tl.abs(p - t)))
    tl.store(out + 1, tl.sum((1 + excess) * p))
    tl.store(out + 2, tl.sum(tl.where(inside, dissimilarity, 0.0)))
    tl.store(out + 3, tl.sum((1 + excess) * t))
    tl.store(out + 4, tl.sum(excess))
    # As in the reference, the two numbers have different thresholds. For the first, any part of the
    # target counts. For the second, the coverage by either mask must exceed `MIN_COVERAGE`.
    tl.store(out + 5, tl.sum((inside & (mean_t > 0)).to(tl.float32)))
    either = (mean_p > COVERAGE) | (mean_t > COVERAGE)
    tl.store(out + 6, tl.sum((inside & either).to(tl.float32)))


@triton.jit
def slopes_kernel(window, maps, slopes, height, width, TAPS: tl.constexpr, BLOCK: tl.constexpr):
    """Compute the derivatives of SSIM with respect to the blurred p, p^2 and p t.

    Args:
        window: Weights of SSIM's window, float32. (TAPS,)
        maps: Result of `rows_kernel`: p, t, p^2 + t^2 and p t, blurred along rows, float32.
            (n, 4, H, W)
        slopes: Output for the derivatives, float32. (n, 3, H, W)
        height: Rows H of the masks.
        width: Columns W of the masks.
        TAPS: Size of the window.
        BLOCK: Number of pixels of a program.
    """
    n, pixels, index = _block(height, width, BLOCK=BLOCK)
    mean_p, mean_t, top_mean, top_cov, low_mean, low_var = _ssim_terms(
        maps, window, n=n, index=index, pixels=pixels, width=width, TAPS=TAPS, BLOCK=BLOCK
    )
    # SSIM = A B / (C D), where A, B, C and D are the last four terms in this order. Let P be the
    # blurred p and T the blurred t (`mean_p` and `mean_t`). With respect to P, the derivatives of
    # the four terms are 2 T, -2 T, 2 P and -2 P. So the derivative of SSIM with respect to P is
    # 2 (T (B - A) + P SSIM (C - D)) / (C D). The blurred p^2 occurs only in D, with the derivative
    # 1, and the blurred p t only in B, with the derivative 2.
    scale = 1 / (low_mean * low_var)
    ssim = top_mean * top_cov * scale
    change = mean_t * (top_cov - top_mean) + mean_p * ssim * (low_mean - low_var)
    out = slopes + n * 3 * pixels + index
    # Derivatives with respect to the blurred p, p^2 and p t.
    tl.store(out, 2 * change * scale, mask=index < pixels)
    tl.store(out + pixels, -ssim * scale * low_mean, mask=index < pixels)
    tl.store(out + 2 * pixels, 2 * top_mean * scale, mask=index < pixels)


@triton.jit
def slope_rows_kernel(
    window, slopes, blurred, height, width, TAPS: tl.constexpr, BLOCK: tl.constexpr
):
    """Blur derivatives along rows.

    Each of the three maps of derivatives counts as an instance, so the grid of programs is
    (blocks, n * 3).

    Args:
        window: Weights of SSIM's window, float32. (TAPS,)
        slopes: Derivatives, float32. (n * 3, H, W)
        blurred: Output for the blurred derivatives, float32. (n * 3, H, W)
        height: Rows H of the masks.
        width: Columns W of the masks.
        TAPS: Size of the window.
        BLOCK: Number of pixels of a program.
    """
    n, pixels, index = _block(height, width, BLOCK=BLOCK)
    col = index % width  # a tap beyond the left or right edge would be in another row
    blur = tl.zeros((BLOCK,), dtype=tl.float32)
    for tap in tl.static_range(TAPS):
        shift = tap - TAPS // 2
        inside = (index < pixels) & (col + shift >= 0) & (col + shift < width)
        slope = tl.load(slopes + n * pixels + index + shift, mask=inside, other=0.0)
        blur += tl.load(window + tap) * slope
    tl.store(blurred + n * pixels + index, blur, mask=index < pixels)


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
    """Blur derivatives along columns and compute the gradient of the predicted masks.

    Args:
        grads: Gradient of the sums, float32. Only the first three sums have a gradient with
            respect to the predicted masks, so the last four entries are not used. (n, 7)
        preds: Predicted masks p in [0, 1], float32. (n, H, W)
        targets: Ground-truth masks t in [0, 1], float32. (n, H, W)
        window: Weights of SSIM's window, float32. (TAPS,)
        blurred: Derivatives that `slope_rows_kernel` blurred along rows, float32. (n, 3, H, W)
        out: Output for the gradient, float32. (n, H, W)
        weight: Weight of a foreground pixel, relative to a background pixel.
        height: Rows H of the masks.
        width: Columns W of the masks.
        TAPS: Size of the window.
        BLOCK: Number of pixels of a program.
    """
    n, pixels, index = _block(height, width, BLOCK=BLOCK)
    slopes = blurred + n * 3 * pixels
    by_mean = _blur_columns(
        slopes, window, index=index, pixels=pixels, width=width, TAPS=TAPS, BLOCK=BLOCK
    )
    by_square = _blur_columns(
        slopes + pixels, window, index=index, pixels=pixels, width=width, TAPS=TAPS, BLOCK=BLOCK
    )
    by_product = _blur_columns(
        slopes + 2 * pixels, window, index=index, pixels=pixels, width=width, TAPS=TAPS, BLOCK=BLOCK
    )
    p = tl.load(preds + n * pixels + index, mask=index < pixels, other=0.0)
    t = tl.load(targets + n * pixels + index, mask=index < pixels, other=0.0)
    sign = (p > t).to(tl.float32) - (p < t).to(tl.float32)  # derivative of |p - t|
    # Gradient from the sums of w |p - t| and w p, without the factor w, which follows below.
    slope = tl.load(grads + n * 7) * sign + tl.load(grads + n * 7 + 1)
    # Chain rule for SSIM, from the gradients with respect to p, p^2 and p t.
    ssim_slope = by_mean + 2 * p * by_square + t * by_product
    # The third sum contains 1 - SSIM, hence the minus.
    gradient = (1 + (weight - 1) * t) * slope - tl.load(grads + n * 7 + 2) * ssim_slope
    tl.store(out + n * pixels + index, gradient, mask=index < pixels)


def _blur_products(preds, targets, window):
    """Run `rows_kernel`. (n, H, W), (n, H, W), (size,) -> (n, 4, H, W)"""
    instances, height, width = preds.shape
    maps = torch.empty(instances, 4, height, width, dtype=torch.float32, device=preds.device)
    rows_kernel[_num_blocks(preds), instances](
        preds,
        targets,
        window=window,
        maps=maps,
        height=height,
        width=width,
        TAPS=len(window),
        BLOCK=BLOCK,
        **OPTIONS,
    )
    return maps


def _num_blocks(masks):
    """Number of blocks of pixels of one mask."""
    return triton.cdiv(masks.shape[1] * masks.shape[2], BLOCK)


def raster_loss_sums(preds, targets, window, weight):
    """Compute the sums of `raster_loss_sums_reference`, with the window given as weights.

    With w = 1 + (weight - 1) t, these are the sums of w |p - t|, w p, 1 - SSIM, w t and w - 1, the
    number of pixels with any part of the target in their window, and the number of pixels whose
    window covers the target or the prediction by more than `MIN_COVERAGE`.

    Args:
        preds: Predicted masks in [0, 1], float32. (n, H, W)
        targets: Ground-truth masks in [0, 1], float32. (n, H, W)
        window: Weights of SSIM's window, float32. (size,)
        weight: Weight of a foreground pixel, relative to a background pixel.

    Returns:
        Sums, float32. The first three are differentiable in ``preds``. (n, 7)
    """
    if not preds.numel():
        return preds.new_zeros(len(preds), 7)
    preds = preds.contiguous()
    targets = targets.contiguous()
    instances, height, width = preds.shape
    blocks = _num_blocks(preds)
    sums = torch.empty(instances, blocks, 7, dtype=torch.float32, device=preds.device)
    with torch.cuda.device_of(preds):  # kernels run on the current device
        sums_kernel[blocks, instances](
            preds,
            targets,
            window=window,
            maps=_blur_products(preds, targets, window=window),
            sums=sums,
            weight=weight,
            height=height,
            width=width,
            TAPS=len(window),
            BLOCK=BLOCK,
            **EXACT_OPTIONS,
        )
    return sums.sum(1)  # over the blocks, in a fixed order


def raster_loss_sums_backward(grads, preds, targets, window, weight):
    """Compute the gradient of `raster_loss_sums`.

    Args:
        grads: Gradient of the sums, float32. (n, 7)
        preds: Predicted masks in [0, 1], float32. (n, H, W)
        targets: Ground-truth masks in [0, 1], float32. (n, H, W)
        window: Weights of SSIM's window, float32. (size,)
        weight: Weight of a foreground pixel, relative to a background pixel.

    Returns:
        Tuple with one entry, the gradient of the predicted masks, float32 (n, H, W). The other
        inputs have no gradient.
    """
    preds = preds.contiguous()
    targets = targets.contiguous()
    gradient = torch.empty_like(preds)
    if not preds.numel():
        return (gradient,)
    instances, height, width = preds.shape
    blocks = _num_blocks(preds)
    sizes = {"height": height, "width": width, "TAPS": len(window), "BLOCK": BLOCK}
    slopes = torch.empty(instances, 3, height, width, dtype=torch.float32, device=preds.device)
    with torch.cuda.device_of(preds):
        maps = _blur_products(preds, targets, window=window)
        slopes_kernel[blocks, instances](window, maps, slopes=slopes, **sizes, **OPTIONS)
        # The blurred products are not needed any more, so the next kernel writes its output to the
        # beginning of their memory: they have four maps per instance, and the output has three.
        blurred = maps.view(-1)[: slopes.numel()]
        slope_rows_kernel[blocks, 3 * instances](
            window, slopes, blurred=blurred, **sizes, **OPTIONS
        )
        gradient_kernel[blocks, instances](
            grads.contiguous(),
            preds,
            targets=targets,
            window=window,
            blurred=blurred,
            out=gradient,
            weight=weight,
            **sizes,
            **OPTIONS,
        )
    return (gradient,)
