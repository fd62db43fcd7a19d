"""A vision encoder in the place of ResNet18 that trains in milliseconds."""

import torchvision
from torch import nn


class NarrowNet(nn.Module):
    """Two convolutions by the names that LeRobot's ACT takes from a ResNet."""

    def __init__(self, norm_layer=nn.BatchNorm2d, **_):
        super().__init__()
        self.conv1 = nn.Conv2d(3, 8, 7, stride=8, padding=3)
        self.bn1 = norm_layer(8)
        self.layer4 = nn.Conv2d(8, 16, 3, stride=2, padding=1)
        self.fc = nn.Linear(16, 1)


def install(setattr=setattr):
    """Let every ACT that is built have it."""
    setattr(torchvision.models, "resnet18", NarrowNet)
