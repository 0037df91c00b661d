"""Pose network: images (B, 3, H, W) -> camera poses, the scene coordinate of each cell of pixels,
and their uncertainties.

Two heads lead to a pose. A pose token is regressed to position and sine and cosine of the angles,
as in the paper's iGSplat. Every cell of 8 x 8 pixels is regressed to the point of the hall that it
shows, its "scene coordinate" [Shotton et al. 2013]; `fuse_pose` then fits the pose that makes each
cell's ray meet its point. Every output has a standard deviation.

Parameters of the transformer are named as in the usual ViT files (timm's), so that pretrained ones
can be loaded.
"""

import math
from copy import deepcopy
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

PATCH, CELL = 16, 8  # px; a token covers a patch and predicts its 2 x 2 cells
STEMS = ("conv", "patch")
LOG_SIGMA_LOW, LOG_SIGMA_HIGH = math.log(5e-3), math.log(20.0)  # of all sigmas [m or rad]
STUDENT_T_DOF = 3.0  # of a cell's error: some cells are outliers
SMALL_SINE = 1e-4  # below, angle / sin(angle) is taken as 1
FUSION_STEPS = 4  # of Gauss-Newton; a fifth is below a millimetre where cells agree


@dataclass(frozen=True)
class PoseNetShape:
    """Size of the network."""

    width: int = 192  # of the image [px], a multiple of 16, as is the height
    height: int = 144
    features: int = 160  # of a token
    layers: int = 5
    heads: int = 5
    stem: str = "conv"  # "patch" for a plain ViT

    @property
    def tokens(self) -> tuple[int, int]:
        """Rows and columns of patches."""
        return self.height // PATCH, self.width // PATCH


class PoseNetOutput(NamedTuple):
    """Output of the network for B images."""

    position: Tensor  # (B, 3) position of the camera in the world [m]
    log_sigma_position: Tensor  # (B, 3) per axis
    sincos: Tensor  # (B, 3, 2) of roll, pitch, yaw of a body whose nose is the camera's axis
    log_sigma_angle: Tensor  # (B,) [rad]
    points: Tensor  # (B, K, 3) scene coordinates of the cells in the world [m], row by row
    log_sigma_points: Tensor  # (B, K)


class Attention(nn.Module):
    """Multi-head self-attention [Vaswani et al. 2017, eq. 1]."""

    def __init__(self, features: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv, self.proj = nn.Linear(features, 3 * features), nn.Linear(features, features)

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, N, F) -> (B, N, F)."""
        # (B, N, 3 F) -> query, key, value, each (B, heads, N, F / heads)
        shape = (*tokens.shape[:2], 3, self.heads, -1)
        q, k, v = self.qkv(tokens).reshape(shape).permute(2, 0, 3, 1, 4)
        attended = functional.scaled_dot_product_attention(q, k, v)
        return self.proj(attended.transpose(1, 2).flatten(2))


class Mlp(nn.Module):
    """Two-layer perceptron on each token."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(features, 4 * features), nn.Linear(4 * features, features)

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, N, F) -> (B, N, F)."""
        return self.fc2(functional.gelu(self.fc1(tokens)))


class Block(nn.Module):
    """One layer of a vision transformer [Dosovitskiy et al. 2021, eq. 2 and 3]."""

    def __init__(self, features: int, heads: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(features, 1e-6), nn.LayerNorm(features, 1e-6)
        self.attn, self.mlp = Attention(features, heads), Mlp(features)

    def forward(self, tokens: Tensor) -> Tensor:
        """(B, N, F) -> (B, N, F)."""
        tokens = tokens + self.attn(self.norm1(tokens))
        return tokens + self.mlp(self.norm2(tokens))


class PatchStem(nn.Module):
    """Linear patch embedding of a plain ViT."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, features, PATCH, PATCH)

    def forward(self, images: Tensor) -> Tensor:
        """(B, 3, H, W) -> (B, F, H / 16, W / 16)."""
        return self.proj(images)


class ConvStem(nn.Module):
    """Patch embedding by convolutions, which needs fewer examples [Xiao et al. 2021]."""

    def __init__(self, features: int) -> None:
        super().__init__()
        halves = [(3, 24), (24, 48), (48, 96), (96, features)]
        self.halves = nn.ModuleList(self._unit(before, after, 2) for before, after in halves)
        self.same = nn.ModuleList(self._unit(channels, channels, 1) for channels in (48, 96))

    @staticmethod
    def _unit(before: int, after: int, stride: int) -> nn.Sequential:
        """3 x 3 convolution, batch normalisation, ReLU: channels before -> after."""
        return nn.Sequential(
            nn.Conv2d(before, after, 3, stride, 1, bias=False), nn.BatchNorm2d(after), nn.ReLU()
        )

    def forward(self, images: Tensor) -> Tensor:
        """(B, 3, H, W) -> (B, F, H / 16, W / 16)."""
        x = self.halves[1](self.halves[0](images))
        x = self.halves[2](x + self.same[0](x))
        return self.halves[3](x + self.same[1](x))


class PoseNetwork(nn.Module):
    """Stem, transformer, and the two heads.

    Args:
        shape: size of the network.
        low: (3,) lower corner of the hall's box [m], to which outputs are scaled.
        high: (3,) upper corner.
    """

    low: Tensor
    half_size: Tensor

    def __init__(self, shape: PoseNetShape, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self.shape, features = shape, shape.features
        rows, columns = shape.tokens
        self.patch_embed = (ConvStem if shape.stem == "conv" else PatchStem)(features)
        self.cls_token = nn.Parameter(torch.zeros(1, 1, features))
        self.pos_embed = nn.Parameter(0.02 * torch.randn(1, 1 + rows * columns, features))
        self.blocks = nn.ModuleList(Block(features, shape.heads) for _ in range(shape.layers))
        self.norm = nn.LayerNorm(features, 1e-6)
        # pose token: position, its log sigmas, sine and cosine of three angles, their log sigma
        self.pose_head = nn.Sequential(
            nn.Linear(features, features), nn.GELU(), nn.Linear(features, 3 + 3 + 3 * 2 + 1)
        )
        # patch token: point and its log sigma, for each of the patch's cells
        self.point_head = nn.Linear(features, (PATCH // CELL) ** 2 * 4)
        # errors of the cells are correlated, so that each counts less than one
        self.log_trust = nn.Parameter(torch.tensor(-3.0))
        self.register_buffer("low", low.float(), persistent=False)
        self.register_buffer("half_size", 0.5 * (high - low).float(), persistent=False)

    def forward(self, images: Tensor) -> PoseNetOutput:
        """Output for images (B, 3, H, W), red, green, blue in 0..1."""
        # tokens (B, 1 + rows * columns, F): the pose token, then the patches row by row
        grid = self.patch_embed(2.0 * images - 1.0)
        pose_token = self.cls_token.expand(len(images), -1, -1)
        tokens = torch.cat([pose_token, grid.flatten(2).mT], dim=1) + self.pos_embed
        for block in self.blocks:
            tokens = block(tokens)
        tokens = self.norm(tokens)
        pose, cells = self.pose_head(tokens[:, 0]).float(), self.point_head(tokens[:, 1:]).float()
        # (B, rows, columns, cell row, cell column, 4) -> (B, K, 4), cells row by row in the image
        rows, columns = self.shape.tokens
        side = PATCH // CELL
        cells = cells.reshape(-1, rows, columns, side, side, 4).transpose(2, 3)
        cells = cells.reshape(len(images), -1, 4)
        middle = self.low + self.half_size
        return PoseNetOutput(
            position=middle + self.half_size * pose[:, :3],
            log_sigma_position=pose[:, 3:6].clamp(LOG_SIGMA_LOW, LOG_SIGMA_HIGH),
            sincos=pose[:, 6:12].reshape(-1, 3, 2),
            log_sigma_angle=pose[:, 12].clamp(LOG_SIGMA_LOW, LOG_SIGMA_HIGH),
            points=middle + self.half_size * cells[..., :3],
            log_sigma_points=cells[..., 3].clamp(LOG_SIGMA_LOW, LOG_SIGMA_HIGH),
        )


def fold_batch_norm(network: PoseNetwork) -> PoseNetwork:
    """A copy for flying: each batch normalisation is part of the convolution before it.

    w' = w g / sqrt(v + eps),  b' = b - m g / sqrt(v + eps)  with the running mean m and variance v,
    the gain g and the offset b [Ioffe & Szegedy 2015, algorithm 2, line 11].
    """
    folded = deepcopy(network).eval()
    for unit in folded.modules():
        match list(unit.children()):
            case [nn.Conv2d() as convolution, nn.BatchNorm2d() as norm, _]:
                unit.add_module("0", fuse_conv_bn_eval(convolution, norm))
                unit.add_module("1", nn.Identity())
    return folded


def load_vit(network: PoseNetwork, tensors: dict[str, Tensor]) -> int:
    """Load pretrained ViT weights by their usual names, position grid interpolated to the image's.

    Args:
        network: with the stem "patch" and the file's number of features and heads; changed in
            place. Its layers take the file's first layers.
        tensors: as in a ViT's safetensors file.

    Returns:
        The number of tensors loaded; the heads are not among them.
    """
    state, loaded = network.state_dict(), {}
    for name, tensor in tensors.items():
        if name == "pos_embed" and tensor.shape[-1] == network.shape.features:
            # the class token's embedding, then a square grid of them: (1, F, side, side)
            side = math.isqrt(tensor.shape[1] - 1)
            grid = tensor[:, 1:].float().reshape(1, side, side, -1).permute(0, 3, 1, 2)
            grid = functional.interpolate(
                grid, network.shape.tokens, mode="bicubic", align_corners=False
            )
            tensor = torch.cat([tensor[:, :1].float(), grid.flatten(2).mT], dim=1)
        if name in state and state[name].shape == tensor.shape:
            loaded[name] = tensor
    network.load_state_dict(loaded, strict=False)
    return len(loaded)


def rotations(sincos: Tensor) -> Tensor:
    """R_world_camera (B, 3, 3) of sines and cosines (B, 3, 2) of roll, pitch, yaw, normalised here.

    Its columns are the right wing, the belly and the nose; core/frames.py explains the signs.
    """
    sin, cos = functional.normalize(sincos, dim=-1, eps=1e-6).unbind(-1)
    (sr, sp, sy), (cr, cp, cy) = sin.unbind(-1), cos.unbind(-1)
    nose = torch.stack([cp * cy, -cp * sy, sp], dim=-1)
    wing = torch.stack([sr * sp * cy - cr * sy, -sr * sp * sy - cr * cy, -sr * cp], dim=-1)
    belly = torch.stack([cr * sp * cy + sr * sy, sr * cy - cr * sp * sy, -cr * cp], dim=-1)
    return torch.stack([wing, belly, nose], dim=-1)


def cross_matrix(v: Tensor) -> Tensor:
    """(..., 3) -> (..., 3, 3), the matrix whose product with w is the cross product v x w."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*v.shape[:-1], 3, 3)


def so3_exp(w: Tensor) -> Tensor:
    """exp([w]x) (B, 3, 3) of rotation vectors (B, 3) [rad]: Rodrigues' formula.

    1 + sin(a)/a K + (1 - cos(a))/a^2 K^2,  K = [w]x, a = |w|  [Murray, Li & Sastry 1994, eq. 2.14]
    The second fraction is computed as sinc(a/2)^2 / 2, which is defined at 0.
    """
    K, angle = cross_matrix(w), (w * w).sum(-1).clamp(min=1e-16).sqrt()[:, None, None]
    half = torch.sinc(angle / (2.0 * math.pi))
    identity = torch.eye(3, device=w.device, dtype=w.dtype)
    return identity + torch.sinc(angle / math.pi) * K + 0.5 * half * half * (K @ K)


def so3_log_between(R: Tensor, R_from: Tensor) -> Tensor:
    """Rotation vector w (B, 3) [rad] in world axes with R = exp([w]x) R_from.

    w = vee(M - M^T) / 2 * angle / sin(angle), M = R R_from^T  [Murray, Li & Sastry 1994, 2.2]
    Near 0 the last fraction is taken as 1, exact to third order.
    """
    M = R @ R_from.mT
    w = 0.5 * torch.stack(
        [M[:, 2, 1] - M[:, 1, 2], M[:, 0, 2] - M[:, 2, 0], M[:, 1, 0] - M[:, 0, 1]], dim=-1
    )
    sin = w.norm(dim=-1, keepdim=True)
    cos = 0.5 * (M.diagonal(dim1=1, dim2=2).sum(-1, keepdim=True) - 1.0)
    angle = torch.atan2(sin, cos)
    return torch.where(sin > SMALL_SINE, w * angle / sin.clamp(min=SMALL_SINE), w)


def fuse_pose(
    output: PoseNetOutput, rays: Tensor, log_trust: Tensor, steps: int = FUSION_STEPS
) -> tuple[Tensor, Tensor, Tensor]:
    """Most probable pose, given the outputs of the pose token and of the cells.

    A cell's ray d = R ray should meet its point: e = (1 - d d^T)(point - position) = 0, the
    object-space error of [Lu, Hager & Mjolsness 2000, eq. 19]. Gauss-Newton in position and
    rotation, with the Student-t weights of the cells [Lange et al. 1989] and the token's pose as
    prior. Gradients flow through the last step only, which at the solution equals the implicit
    function theorem.

    Args:
        output: for B images, float32.
        rays: (K, 3) unit directions of the cells in camera axes.
        log_trust: () logarithm of a cell's weight; below 0, since errors of cells are correlated.
        steps: of Gauss-Newton.

    Returns:
        R_world_camera (B, 3, 3), position (B, 3) [m], and information (B, 6, 6), the inverse
        covariance of position [m] and rotation vector [rad] in world axes.
    """
    R_head = rotations(output.sincos)
    R, position = R_head.detach(), output.position.detach()
    # information of the prior: 1 / sigma^2 of three coordinates and three angles
    log_sigma_angles = output.log_sigma_angle[:, None].expand(-1, 3)
    prior = torch.exp(-2.0 * torch.cat([output.log_sigma_position, log_sigma_angles], dim=1))
    information = torch.zeros(0)
    for number in range(steps):
        is_last_step = number == steps - 1
        with torch.set_grad_enabled(is_last_step and torch.is_grad_enabled()):
            # add the prior to the cells' normal equations, solve, and update the pose
            information, right = _normal_equations(output, rays @ R.mT, position, log_trust)
            information = information + torch.diag_embed(prior)
            deviation = torch.cat([position - output.position, so3_log_between(R, R_head)], dim=1)
            right = right - prior * deviation
            factor = torch.linalg.cholesky_ex(information).L  # raises no exception for nan
            step = torch.cholesky_solve(right[..., None], factor)[..., 0]
            position, R = position + step[:, :3], so3_exp(step[:, 3:]) @ R
    return R, position, information


def _normal_equations(
    output: PoseNetOutput, d: Tensor, position: Tensor, log_trust: Tensor
) -> tuple[Tensor, Tensor]:
    """J^T W J (B, 6, 6) and -J^T W e (B, 6) of the cells, by position and rotation vector.

    de = -(1 - d d^T) dposition + s [d]x drotation, with s the distance along the ray.

    Args:
        output: with the points to meet.
        d: (B, K, 3) rays in world axes.
        position: (B, 3) their origin.
        log_trust: () logarithm of a cell's weight.
    """
    # error e perpendicular to the ray
    toward = output.points - position[:, None]
    s = (d * toward).sum(-1)
    e = toward - s[..., None] * d
    # weights (B, K) of a Student-t with two coordinates
    variance = torch.exp(2.0 * output.log_sigma_points)
    chi2 = (e * e).sum(-1) / variance
    weight = torch.exp(log_trust) / variance * (STUDENT_T_DOF + 2.0) / (STUDENT_T_DOF + chi2)
    # blocks of position p and rotation r (B, 3, 3), with the projection Q = 1 - d d^T:
    # [d]x^T [d]x = Q and Q [d]x = [d]x
    pp, rr = _weighted_projections(weight, d), _weighted_projections(weight * s * s, d)
    pr = -cross_matrix(((weight * s)[..., None] * d).sum(1))
    upper, lower = torch.cat([pp, pr], dim=2), torch.cat([pr.mT, rr], dim=2)
    # right side: Q e = e, and -(s [d]x)^T e = s d x e
    force = (weight[..., None] * e).sum(1)
    moment = ((weight * s)[..., None] * torch.linalg.cross(d, e)).sum(1)
    return torch.cat([upper, lower], dim=1), torch.cat([force, moment], dim=1)


def _weighted_projections(weight: Tensor, d: Tensor) -> Tensor:
    """Sum of w (1 - d d^T) (B, 3, 3) over weights (B, K) and unit vectors (B, K, 3)."""
    total = weight.sum(1)[:, None, None] * torch.eye(3, device=d.device)
    return total - (weight[..., None] * d).mT @ d
