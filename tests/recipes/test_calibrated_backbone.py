"""A backbone that begins from nothing is normalised at every layer, and stays as it is then."""

from __future__ import annotations

import pytest

pytestmark = pytest.mark.lerobot


def test_every_frozen_norm_normalises_what_comes_to_it():
    import torch
    from torchvision.models import resnet18
    from torchvision.ops import FrozenBatchNorm2d

    from recipes.calibrated_backbone import calibrate

    torch.manual_seed(0)
    backbone = resnet18(weights=None, norm_layer=FrozenBatchNorm2d)
    pictures = torch.rand(24, 3, 32, 32)
    plain = backbone(pictures)
    assert calibrate(backbone, pictures) == 20
    seen: dict[str, torch.Tensor] = {}
    for name, module in backbone.named_modules():
        if isinstance(module, FrozenBatchNorm2d):
            module.register_forward_hook(lambda _m, _i, out, name=name: seen.update({name: out.clone()}))
    out = backbone(pictures)
    assert len(seen) == 20
    for name, value in seen.items():  # copies: the ReLU that follows works in place
        assert value.mean(dim=(0, 2, 3)).abs().max() < 1e-3, name
        assert (value.var(dim=(0, 2, 3)) - 1).abs().max() < 0.05, name
    assert torch.equal(out, backbone(pictures))
    assert not torch.allclose(out, plain, atol=0.1)
    names = set(backbone.state_dict())
    assert {"bn1.running_mean", "bn1.running_var"} <= names
