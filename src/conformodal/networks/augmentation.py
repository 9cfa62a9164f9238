"""Augmentation that leaves the pose as it is: light, colour, noise, occlusion."""

from __future__ import annotations

import torch

from .shares import BatchShare

_GAIN, _CONTRAST, _TINT = 0.3, 0.3, 0.1
_NOISE = 12.0  # of 255
_COVER_SHARE, _COVER_SIZE = 0.5, 0.35


def augment(images: torch.Tensor, share: BatchShare | None = None) -> torch.Tensor:
    """Change every image of a batch in its own way.

    Nothing is moved, turned or mirrored: that would need another pose.

    Parameters
    ----------
    images
        (n, h, w, 3) in 0 to 255, any real type.
    share
        Which rows of a larger batch these are; None where they are all.

    Returns
    -------
    torch.Tensor
        float32, same shape and range, by torch's random numbers.
    """
    x = images.to(dtype=torch.float32)
    _, h, w, _ = x.shape
    mine = share or BatchShare(len(x))

    def uniform(reach: float, *shape: int) -> torch.Tensor:
        return (2 * mine.of(torch.rand, *shape, device=x.device) - 1) * reach

    mean = x.mean(dim=(1, 2, 3), keepdim=True)
    x = (x - mean) * (1 + uniform(_CONTRAST, 1, 1, 1)) + mean
    x = x * (1 + uniform(_GAIN, 1, 1, 1)) * (1 + uniform(_TINT, 1, 1, 3))
    noise = mine.of(torch.randn, *x.shape[1:], device=x.device)
    x = x + noise * mine.of(torch.rand, 1, 1, 1, device=x.device) * _NOISE
    # one rectangle a picture, of one colour, over some of the pictures
    rows, columns = (torch.arange(size, device=x.device)[None] for size in (h, w))
    top, left = (mine.of(torch.rand, 1, device=x.device) * size for size in (h, w))
    high, wide = (mine.of(torch.rand, 1, device=x.device) * size * _COVER_SIZE for size in (h, w))
    covered = ((rows >= top) & (rows < top + high))[:, :, None] & ((columns >= left) & (columns < left + wide))[:, None]
    covered &= mine.of(torch.rand, 1, 1, device=x.device) < _COVER_SHARE
    colour = 255 * mine.of(torch.rand, 1, 1, 3, device=x.device)
    return torch.where(covered[..., None], colour, x).clamp(0, 255)
