"""Mask network: the U-Net of leader_mask.py in PyTorch, which trains it."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

from falconwing_kit.vision.leader_mask import DOWN, PREFIX, UP
from falconwing_kit.vision.policy_network import ConvUnit, standardise

RARE = -5.0  # logit of the leader's share of an image


class MaskNetwork(nn.Module):
    """Images -> logits of the leader's share of each pixel."""

    def __init__(self) -> None:
        super().__init__()
        down, up, channels, beside = [], [], 3, [3]
        for out, kernel, stride in DOWN:
            down.append(ConvUnit(channels, out, kernel, stride))
            channels = out
            beside.append(out)
        for k, out in enumerate(UP):
            up.append(ConvUnit(channels + beside[len(UP) - 1 - k], out, 3, 1))
            channels = out
        self.down, self.up = nn.ModuleList(down), nn.ModuleList(up)
        self.out = nn.Conv2d(channels, 1, 1)
        nn.init.constant_(self.out.bias, RARE)  # type: ignore[arg-type]

    def forward(self, images: Tensor) -> Tensor:
        """Logits (N, h, w) of images (N, 3, h, w) in 0..1."""
        x = standardise(images)
        maps = [x]
        for unit in self.down:
            x = unit(x)
            maps.append(x)
        for k, unit in enumerate(self.up):
            beside = maps[len(UP) - 1 - k]
            doubled = x.repeat_interleave(2, dim=2).repeat_interleave(2, dim=3)
            doubled = doubled[:, :, : beside.shape[2], : beside.shape[3]]
            x = unit(torch.cat([doubled, beside], dim=1))
        return self.out(x)[:, 0]

    def weights(self) -> dict[str, Tensor]:
        """The arrays of `leader_mask`, batch normalisation folded in."""
        found: dict[str, Tensor] = {}
        for name, unit in self._units():
            weight, bias = unit.folded()
            found |= {f"{PREFIX}{name}.weight": weight, f"{PREFIX}{name}.bias": bias}
        bias = self.out.bias if self.out.bias is not None else torch.zeros(1)
        found |= {f"{PREFIX}out.weight": self.out.weight, f"{PREFIX}out.bias": bias}
        return {name: w.detach().float().cpu().contiguous() for name, w in found.items()}

    @torch.no_grad()
    def restore(self, weights: Mapping[str, Tensor]) -> None:
        """Take the arrays of `weights`."""
        for name, unit in self._units():
            unit.restore(weights[f"{PREFIX}{name}.weight"], weights[f"{PREFIX}{name}.bias"])
        self.out.weight.copy_(weights[f"{PREFIX}out.weight"])
        if self.out.bias is not None:
            self.out.bias.copy_(weights[f"{PREFIX}out.bias"])

    def _units(self) -> list[tuple[str, ConvUnit]]:
        """The convolutions by their names in a file."""
        named = [(f"down{k}", unit) for k, unit in enumerate(self.down)]
        named += [(f"up{k}", unit) for k, unit in enumerate(self.up)]
        return [(name, unit) for name, unit in named if isinstance(unit, ConvUnit)]


def mask_loss(logits: Tensor, shares: Tensor) -> Tensor:
    """Cross entropy, and one minus the overlap [Milletari, Navab & Ahmadi 2016, eq. 2].

    Args:
        logits: (N, h, w).
        shares: (N, h, w) the leader's, 0..1; few pixels are its own, which the overlap weighs.
    """
    found = torch.sigmoid(logits)
    both, each = (found * shares).sum((1, 2)), (found**2).sum((1, 2)) + (shares**2).sum((1, 2))
    overlap = (2.0 * both + 1.0) / (each + 1.0)
    entropy = functional.binary_cross_entropy_with_logits(logits, shares)
    return 10.0 * entropy + (1.0 - overlap).mean()
