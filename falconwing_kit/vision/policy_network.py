"""Policy network: sequences of images and inputs -> commands and, in training only, the state;
PyTorch layers of policy.py.

    image -> convolutions -> features; features, inputs -> gated recurrent unit -> head -> commands

In training, two auxiliary heads estimate the state from the memory and from the features: what the
aircraft needs to fly must be in both. They are not saved.
"""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

from falconwing_kit.vision.layers import SMALLEST_DEVIATION
from falconwing_kit.vision.policy import CHANNELS, CONTROLS, PolicyShape


class ConvUnit(nn.Module):
    """Convolution, batch normalisation, ReLU."""

    def __init__(self, before: int, after: int, kernel: int, stride: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(before, after, kernel, stride, kernel // 2, bias=False)
        self.norm = nn.BatchNorm2d(after)

    def forward(self, x: Tensor) -> Tensor:
        """(N, before, h, w) -> (N, after, h / stride, w / stride)."""
        return functional.relu(self.norm(self.conv(x)))

    def folded(self) -> tuple[Tensor, Tensor]:
        """Weight and bias of the one convolution that does the same in evaluation.

        gamma (W x - mean) / sqrt(var + eps) + beta = (gamma / s) W x + (beta - gamma mean / s)
        """
        norm = self.norm
        if norm.running_var is None or norm.running_mean is None:
            raise RuntimeError("batch normalisation without running statistics")
        gain = norm.weight / torch.sqrt(norm.running_var + norm.eps)
        return self.conv.weight * gain[:, None, None, None], norm.bias - gain * norm.running_mean

    @torch.no_grad()
    def restore(self, weight: Tensor, bias: Tensor) -> None:
        """Take a folded convolution; `calibrate` before it is trained on."""
        norm = self.norm
        self.conv.weight.copy_(weight)
        norm.reset_parameters()  # scale 1, mean 0, variance 1
        norm.weight.fill_((1.0 + norm.eps) ** 0.5)
        norm.bias.copy_(bias)

    @torch.no_grad()
    def calibrate(self, x: Tensor) -> None:
        """Take the statistics of a batch (N, before, h, w) into the normalisation.

        The unit computes the same as before, and in training mode too.
        """
        norm = self.norm
        if norm.running_var is None or norm.running_mean is None:
            raise RuntimeError("batch normalisation without running statistics")
        variance, mean = torch.var_mean(self.conv(x).float(), dim=(0, 2, 3), correction=0)
        gain = norm.weight / torch.sqrt(norm.running_var + norm.eps)
        norm.bias.add_(gain * (mean - norm.running_mean))
        norm.weight.copy_(gain * torch.sqrt(variance + norm.eps))
        norm.running_mean.copy_(mean)
        norm.running_var.copy_(variance)


def calibrate(network: nn.Module, run: Callable[[], object]) -> None:
    """Calibrate every `ConvUnit` of a network on what it is given while `run` runs the network."""

    def take(unit: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        assert isinstance(unit, ConvUnit)
        unit.calibrate(inputs[0])

    units = [unit for unit in network.modules() if isinstance(unit, ConvUnit)]
    handles = [unit.register_forward_pre_hook(take) for unit in units]
    was_training = network.training
    network.eval()
    try:
        with torch.no_grad():
            run()
    finally:
        network.train(was_training)
        for handle in handles:
            handle.remove()


class PolicyNetwork(nn.Module):
    """Encoder of an image, memory, and heads.

    Args:
        shape: sizes.
        auxiliary: numbers of the state that the auxiliary heads estimate.
    """

    def __init__(self, shape: PolicyShape, auxiliary: int) -> None:
        super().__init__()
        self.shape = shape
        units, channels = [], CHANNELS[shape.sees]
        for after, kernel, stride in shape.convolutions:
            units.append(ConvUnit(channels, after, kernel, stride))
            channels = after
        rows, columns = shape.grid
        self.units = nn.Sequential(*units)
        self.features = nn.Linear(channels * rows * columns, shape.features)
        read = shape.features + shape.inputs
        if shape.memory:
            self.memory: nn.GRU | None = nn.GRU(read, shape.memory, batch_first=True)
            self.mix = None
        else:
            self.memory, self.mix = None, nn.Linear(read, shape.features)
        out = shape.memory or shape.features
        self.head = nn.Linear(out + shape.features, shape.hidden)
        self.commands = nn.Linear(shape.hidden, CONTROLS)
        self.state_of_memory = nn.Linear(out, auxiliary)
        self.state_of_image = nn.Linear(shape.features, auxiliary)

    def encode(self, images: Tensor) -> Tensor:
        """Features (N, F) of images (N, C, h, w) in 0..1: red, green, blue, mask."""
        maps = self.units(standardise(images))
        return functional.layer_norm(self.features(maps.flatten(1)).float(), (self.shape.features,))

    def forward(
        self, features: Tensor, inputs: Tensor, memory: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Commands and states along sequences.

        Args:
            features: (B, T, F).
            inputs: (B, T, I) of `policy_inputs`.
            memory: (1, B, M) before the first step; None for zeros.

        Returns:
            Commands (B, T, 4), states estimated from memory and from the image (B, T, A), and the
            memory after the last step.
        """
        x = torch.cat([features, inputs], dim=-1)
        if self.memory is not None:
            x, memory = self.memory(x, memory)
        elif self.mix is not None:
            x = functional.relu(self.mix(x))
        hidden = functional.relu(self.head(torch.cat([x, features], dim=-1)))
        return self.commands(hidden), self.state_of_memory(x), self.state_of_image(features), memory

    def weights(self) -> dict[str, Tensor]:
        """The arrays of `Policy`, batch normalisation folded in."""
        found: dict[str, Tensor] = {}
        for layer, unit in enumerate(self.units):
            if isinstance(unit, ConvUnit):
                found[f"conv{layer}.weight"], found[f"conv{layer}.bias"] = unit.folded()
        found |= self._dense()
        return {name: w.detach().float().cpu().contiguous() for name, w in found.items()}

    @torch.no_grad()
    def restore(self, weights: Mapping[str, Tensor]) -> None:
        """Take the arrays of `weights`; the auxiliary heads stay as they are."""
        for layer, unit in enumerate(self.units):
            if isinstance(unit, ConvUnit):
                unit.restore(weights[f"conv{layer}.weight"], weights[f"conv{layer}.bias"])
        for name, parameter in self._dense().items():
            parameter.copy_(weights[name])

    def _dense(self) -> dict[str, Tensor]:
        """The parameters of all layers but the convolutions that fly, by their names in a file."""
        found: dict[str, Tensor] = {}
        dense: dict[str, nn.Linear] = {
            "features": self.features,
            "head": self.head,
            "commands": self.commands,
        }
        if self.mix is not None:
            dense["mix"] = self.mix
        for name, linear in dense.items():
            found |= {f"{name}.weight": linear.weight, f"{name}.bias": linear.bias}
        if self.memory is not None:
            for part in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
                found[f"memory.{part}"] = getattr(self.memory, f"{part}_l0")
        return found


def standardise(images: Tensor) -> Tensor:
    """Images (N, C, h, w) with mean 0 and standard deviation 1 over their colours; a mask stays."""
    colours = images[:, :3] if images.shape[1] >= 3 else images[:, :0]
    if colours.shape[1] == 0:
        return images
    deviation = colours.std(dim=(1, 2, 3), keepdim=True, correction=0)
    scaled = colours - colours.mean(dim=(1, 2, 3), keepdim=True)
    return torch.cat([scaled / deviation.clamp(min=SMALLEST_DEVIATION), images[:, 3:]], dim=1)
