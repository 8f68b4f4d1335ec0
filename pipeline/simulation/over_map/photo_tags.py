"""The tags of a simulated photo, as small UAVs write them: XMP with gimbal, height and lens."""

from pipeline.camera.ground import focal_length_px
from pipeline.camera.pose import Pose

XMP_HEADER = b"http://ns.adobe.com/xap/1.0/\0"
"Begins the APP1 segment of a JPEG that holds XMP [XMP specification, part 3, 1.1.3]."
PACKET = """<x:xmpmeta xmlns:x="adobe:ns:meta/">
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"
 drone-dji:GimbalYawDegree="{heading:+.2f}" drone-dji:GimbalPitchDegree="{pitch:+.2f}"
 drone-dji:GimbalRollDegree="+0.00" drone-dji:RelativeAltitude="{height:+.2f}"
 drone-dji:CalibratedFocalLength="{focal:.3f}"/>
</rdf:RDF></x:xmpmeta>"""


def with_camera_tags(jpeg: bytes, pose: Pose, width: int) -> bytes:
    """The JPEG of `width` pixels with an XMP segment behind its first two bytes; no position."""
    packet = PACKET.format(
        heading=(pose.heading_deg + 180) % 360 - 180,
        pitch=pose.pitch_deg,
        height=pose.altitude_m,
        focal=focal_length_px(pose.fov_deg, width),
    ).encode()
    segment = XMP_HEADER + packet
    return jpeg[:2] + b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big") + segment + jpeg[2:]
