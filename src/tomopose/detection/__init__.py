"""Detection: the projection of the ball's centre in each radiograph, at the accuracy that the noise allows."""

from tomopose.detection.image import detect_image
from tomopose.detection.result import BallImage
from tomopose.detection.run.detect import detect
from tomopose.detection.settings import DetectionSettings

__all__ = ["BallImage", "DetectionSettings", "detect", "detect_image"]
