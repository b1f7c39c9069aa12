# Made by docs/tools/reference.py from table.toml; run `make reference` again.

class OutputGroup:
    parameters: str
    cell: str
    json: str
    report: str

class LandingGroup:
    height: float

class ReleaseGroup:
    delay: float
    fall: float
    closing: float
    opening: float
    damping: float
    sticking: float
    std: tuple[float, ...]
    correlation: tuple[float, ...]
    mass_range: tuple[float, ...]

class SafetyGroup:
    least: float

class VacuumGroup:
    signal: str
    thresholds: tuple[float, ...]
    holding: float

class AlarmGroup:
    false_per_hour: float

class PayloadGroup:
    estimate: bool

class GripperGroup:
    mass: float
    com: tuple[float, ...]

class WrenchGroup:
    frame: str
    sign: str
    bias_std: tuple[float, ...]
    delay: float

class MeasuredGroup:
    type: str
    rectified: bool
    child_frame: str
    tag_size: float
    noise: tuple[float, ...]
    exposure: float
    scale: float
    frame: str
    offset: tuple[float, ...]
    marker_std: tuple[float, ...]
    camera_std: tuple[float, ...]
    latency: tuple[float, ...]

class FramesGroup:
    world: str
    tool: str

class ToolTwistGroup:
    frame: str

class ToolPoseGroup:
    type: str
    offset: str

class GravityGroup:
    magnitude: float
    direction: tuple[float, ...]

class FitGroup:
    method: str
    structure: str
    stretch: str
    relaxation: str
    free: tuple[str, ...]

class CupGroup:
    length: float
    stiffness: tuple[float, ...]
    damping: tuple[float, ...]
    relaxation: tuple[float, ...]
    stretch: tuple[float, ...]
    valid_low: tuple[float, ...]
    valid_high: tuple[float, ...]
    layout: tuple[float, ...]
    open: tuple[float, ...]
    length_std: float
    stiffness_std: tuple[float, ...]
    damping_std: tuple[float, ...]
    lip_radius: float
    suction_area: float
    friction: float

class PackageGroup:
    mass: float
    inertia: tuple[float, ...]
    com: tuple[float, ...]
    mass_std: float
    inertia_std: tuple[float, ...]
    com_std: tuple[float, ...]
    size: tuple[float, ...]
    files: tuple[str, ...]

class RecordingGroup:
    world: str
    package_frame: str
    package_world: str
    align_at_rest: bool
    marker_std: tuple[float, ...]
    marker: str
    clock_std: float
    start: float
    end: float

class TopicsGroup:
    tool_pose: str
    tool_twist: str
    package_pose: str
    valve: str
    vacuum: str

class Groups:
    def __init__(self, prefix: str) -> None: ...
    bags: tuple[str, ...]
    topics: TopicsGroup
    recording: RecordingGroup
    package: PackageGroup
    cup: CupGroup
    fit: FitGroup
    gravity: GravityGroup
    tool_pose: ToolPoseGroup
    tool_twist: ToolTwistGroup
    tool_link: str
    frames: FramesGroup
    autostart: bool
    tool_noise: tuple[float, ...]
    measured: MeasuredGroup
    wrench: WrenchGroup
    gripper: GripperGroup
    payload: PayloadGroup
    alarm: AlarmGroup
    vacuum: VacuumGroup
    safety: SafetyGroup
    release: ReleaseGroup
    landing: LandingGroup
    output: OutputGroup
    predictor: str
