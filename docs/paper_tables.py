"""Tables and figures of the four papers, each row in the paper's order beside ours."""

from __future__ import annotations

from claims import Claim, Measure, PaperTable, share

# --- Residual Force Control -------------------------------------------------------------------------

_PAPERS = "python -m benchmarks papers --only"
_IMITATE = "python -m benchmarks imitate --only"
_AGILE = {
    "05_06": "05_06 (ballet1)",
    "05_07": "05_07 (ballet2)",
    "05_13": "05_13 (ballet3)",
    "backflip": "88_01 (backflip), ours DeepMimic's",
    "90_02": "90_02 (cartwheel)",
    "90_05": "90_05 (jump kick)",
    "90_08": "90_08 (side flip)",
    "90_11": "90_11 (handspring)",
}
_IMITATED = {
    "05_06": "CMU 05_06, dance, never learned",
    "05_07": "CMU 05_07, dance, never learned",
    "05_13": "CMU 05_13, dance, never learned",
    "backflip": "DeepMimic backflip",
    "90_02": "CMU 90_02, cartwheel",
    "90_05": "CMU 90_05, jump kick",
    "90_08": "CMU 90_08, side flip",
    "90_11": "CMU 90_11, handspring",
}


def _curve(method: str, clip: str = "{}") -> str:
    return f"papers:Residual Force Control, Figure 2, {clip}; {method}"


def _curves() -> tuple[Claim, ...]:
    """The eight clips, and what is said of all of them."""
    every, reward = tuple(_AGILE), ("return_last",)
    out = [
        Claim(
            f"{title}, {name}",
            _curve(method, clip),
            "better",
            _curve("deepmimic", clip),
            "DeepMimic",
            judged=reward,
        )
        for clip, title in _AGILE.items()
        for method, name in (("rfc-explicit", "RFC-Explicit"), ("rfc-implicit", "RFC-Implicit"))
    ]
    for method, name in (("rfc-explicit", "RFC-Explicit"), ("rfc-implicit", "RFC-Implicit")):
        than = _curve("deepmimic")
        out.append(
            Claim(
                f"all clips, {name}",
                _curve(method),
                "better",
                than,
                "DeepMimic",
                judged=reward,
                over=every,
            )
        )
    out += [
        Claim(
            "all clips, RFC-Explicit",
            _curve("rfc-explicit"),
            "alike",
            _curve("rfc-implicit"),
            "RFC-Implicit",
            judged=reward,
            over=every,
        ),
        Claim(
            "all clips, DeepMimic (ours alone)",
            _curve("deepmimic"),
            "better",
            _curve("nothing"),
            "nothing (action 0)",
            judged=("eval_imitation", "succ"),
            over=every,
            printed="no row",
        ),
        *(
            Claim(
                f"gains by {factor} (App. C)",
                _curve(f"rfc-implicit, gains by {factor}"),
                "alike",
                _curve("rfc-implicit"),
                "the usual gains",
                judged=reward,
                over=every,
                printed="in words",
            )
            for factor in ("0.5", "2")
        ),
    ]
    return tuple(out)


_FIGURE_2 = PaperTable(
    (
        Measure("return", "return_last", "1"),
        Measure("reward", "eval_imitation", "2"),
        Measure("success", "succ", "%"),
    ),
    _curves(),
    f"{_PAPERS} 'residual forces'",
    "Residual Force Control, Figure 2; any policy",
    "a curve",
)
_SOONER = PaperTable(
    (Measure("control steps, thousand", "thousand_to_deepmimic", "0", -1),),
    tuple(
        Claim(
            f"all clips, {name}",
            _curve(method),
            "better",
            _curve("deepmimic"),
            "DeepMimic",
            over=tuple(_AGILE),
        )
        for method, name in (("rfc-explicit", "RFC-Explicit"), ("rfc-implicit", "RFC-Implicit"))
    ),
    f"{_PAPERS} 'residual forces'",
    "Residual Force Control, Figure 2; any policy",
    "a curve",
)
_ALONE = PaperTable(
    (
        Measure("success from all starts", "success_over_all_starts", "%"),
        Measure("MPJPE, mm", "mpjpe_mm", "1", -1),
    ),
    (
        *(
            Claim(f"{title}, {how}", f"imitate:{_IMITATED[clip]}{more}", run=f"{_IMITATE} {part}")
            for clip, title in _AGILE.items()
            for how, more, part in (
                ("from nothing", "; from nothing, seed *", "'from nothing'"),
                ("from the policy that ships", "", "shipped"),
            )
            if (clip, how) != ("backflip", "from nothing")
        ),
    ),
    printed="a video, with force",
)
_SITTING = PaperTable(
    (
        share("success", "succ"),
        Measure("reward", "eval_imitation", "2"),
        Measure("help, N", "force_mean_n", "0", -1),
        Measure("help, N m", "torque_mean_nm", "0", -1),
    ),
    (
        Claim("nothing (action 0)", _curve("nothing", "sitting"), printed="no row"),
        Claim("DeepMimic", _curve("deepmimic", "sitting"), printed="no row"),
        *(
            Claim(
                name,
                _curve(method, "sitting"),
                "better",
                _curve("deepmimic", "sitting"),
                "DeepMimic",
                judged=("succ", "eval_imitation"),
            )
            for method, name in (("rfc-explicit", "RFC-Explicit"), ("rfc-implicit", "RFC-Implicit"))
        ),
    ),
    f"{_PAPERS} 'residual sitting'",
    printed="a video, with force",
)
_ONE = "papers:Residual Force Control, App. C, one character; {}"
_TIMES = PaperTable(
    (Measure("ms a step", "ms_a_step", "2", -1),),
    tuple(
        Claim(
            name,
            _ONE.format(method),
            says,
            _ONE.format("deepmimic") if says else "",
            "no residual force" if says else "",
            f"Residual Force Control, App. C; {name}",
        )
        for name, method, says in (
            ("no residual force", "deepmimic", ""),
            ("RFC-Explicit", "rfc-explicit", "worse"),
            ("RFC-Implicit", "rfc-implicit", "worse"),
        )
    ),
    f"{_PAPERS} 'residual times'",
)


def _predicted(method: str, library: str = "CMU", split: str = "") -> str:
    return f"papers:Residual Force Control, Tables 1 and 2; {library}/all/*/{method}{split}"


_BOTH = "Mix and Cross together"


def _forecasts() -> tuple[Claim, ...]:
    out, both = list[Claim](), ("mae_rad", "fae_rad")
    for part, library, split in (
        ("Human3.6M (Mix)", "CMU", ", mix"),
        ("Human3.6M (Cross)", "CMU", ", cross"),
        ("EgoMocap", "Bandai", ""),
        (_BOTH, "CMU", ""),
    ):
        than = _predicted("RFC-Implicit", library, split)
        for name in ("RFC-Explicit", "RFC-Implicit", "EgoPose", "ERD", "acLSTM"):
            ours, says = _predicted(name, library, split), "" if name.startswith("RFC") else "worse"
            paper = "" if part == _BOTH else f"Residual Force Control, Table 1, {part}; {name}"
            row = f"{part}, ours {library}, {name}"
            out.append(Claim(row, ours, says, than, "RFC-Implicit", paper, both, printed="no row"))
        row = f"{part}, ours {library}, standing still (ours alone)"
        ours = _predicted("zero velocity", library, split)
        out.append(Claim(row, ours, "worse", than, "RFC-Implicit", "", both, printed="no row"))
    return tuple(out)


_ANGLES = (
    Measure("MAE, rad", "mae_rad", "3", -1),
    Measure("FAE, rad", "fae_rad", "3", -1),
    share("fallen", "fallen", -1),
    Measure("root, m", "root_m", "2", -1),
    Measure("diversity, rad", "diversity_rad", "2"),
)
_TABLE_1 = PaperTable(
    _ANGLES,
    _forecasts(),
    f"{_PAPERS} prediction",
    "Residual Force Control, Tables 1 and 2; any control policy",
)
_WHOLE = _predicted("RFC-Implicit")
_TABLE_2 = PaperTable(
    _ANGLES,
    (
        Claim(
            "AddAct and ResForce", _WHOLE, paper="Residual Force Control, Table 2; AddAct and ResForce"
        ),
        *(
            Claim(
                name,
                _predicted(method),
                "worse",
                _WHOLE,
                "both",
                f"Residual Force Control, Table 2; {name}",
                judged=("mae_rad", "fae_rad"),
            )
            for name, method in (
                ("AddAct alone", "no residual force"),
                ("ResForce alone", "no additive action"),
            )
        ),
        Claim(
            "the kinematic policy without a body (ours alone)",
            _predicted("ours"),
            "worse",
            _WHOLE,
            "both",
            judged=("mae_rad", "fae_rad"),
            printed="no row",
        ),
        *(
            Claim(f"{name} (ours alone)", _predicted(name), printed="no row")
            for name in (
                "servos",
                "universal policy",
                "universal + no residual force",
                "universal + RFC-Implicit",
            )
        ),
    ),
    f"{_PAPERS} prediction",
    "Residual Force Control, Tables 1 and 2; any control policy",
)
_STILL = "dream:nothing (action 0)"
_ENDLESS = PaperTable(
    (
        Measure("falls an hour", "falls_per_hour", "0", -1),
        Measure("stayed down", "stayed_down", "0", -1),
        Measure("slide, mm/s", "foot_slide_mm_per_s", "0", -1),
        Measure("jerk, m/s³", "jerk_m_per_s3", "0", -1),
    ),
    (
        *(
            Claim(
                name, f"dream:{ours}", "better", _STILL, "nothing (action 0)", judged=("falls_per_hour",)
            )
            for name, ours in (
                ("motion without end, ten minutes each", "policy alone, ten minutes each"),
                ("motion without end, a minute each", "policy alone"),
                ("futures tried, ten minutes each (ours alone)", "futures tried, ten minutes each"),
                ("the same with lookahead, ten minutes each (ours alone)", "lookahead"),
            )
        ),
        Claim("nothing (action 0), which stays down", _STILL, printed="no row"),
    ),
    "python -m benchmarks dream",
    printed="a video",
)

# --- Skeleton2Humanoid ------------------------------------------------------------------------------

_LENGTHS = (5, 15, 30)
_SKELETON = f"{_PAPERS} skeleton"
_GAPS = (
    Measure("FP, mm", "fp_mm", "2"),
    Measure("FQ, %", "fq_percent", "1", -1, 100.0),
    Measure("JQ, %", "jq_percent", "1", -1, 100.0),
    Measure("SM, mm", "sm_mm", "1", -1),
    Measure("L2P", "l2p", "2", -1),
    Measure("slide, mm/s", "slide_mm_per_s", "0", -1),
)


def _stage(stage: str, length: int) -> str:
    return f"papers:Skeleton2Humanoid, {length} frames; {stage}"


def _stages() -> tuple[Claim, ...]:
    worse = ("fp_mm", "fq_percent", "jq_percent", "l2p")
    last = ("fp_mm", "fq_percent", "jq_percent", "sm_mm", "-l2p")
    return tuple(
        Claim(
            f"{name}, {n} frames",
            _stage(ours, n),
            says,
            _stage(than, n),
            beside,
            f"Skeleton2Humanoid, Table 1, {n} frames; {name}",
            judged,
        )
        for name, ours, says, than, beside, judged in (
            ("baseline", "base", "", "", "", ()),
            ("baseline w/ TTA", "base + TTA", "better", "base", "the baseline", ()),
            ("baseline w/ TTA, IK", "base + TTA + IK", "worse", "base + TTA", "TTA", worse),
            (
                "baseline w/ TTA, IK, CRP",
                "full",
                "better",
                "base",
                "the baseline, L2P worse",
                last,
            ),
        )
        for n in _LENGTHS
    )


_S2H_1 = PaperTable(_GAPS, _stages(), _SKELETON, "Skeleton2Humanoid, Table 4; any policy")
_PHYSICS = ("fp_mm", "fq_percent", "jq_percent", "slide_mm_per_s")
_S2H_1_OURS = PaperTable(
    _GAPS,
    tuple(
        Claim(f"{name}, {n} frames", _stage(ours, n), says, _stage(than, n), than, judged=judged)
        for name, ours, says, than, judged in (
            ("recorded", "recorded", "", "", ()),
            ("recorded, set on the floor", "recorded, set on the floor", "", "", ()),
            ("baseline, set on the floor", "base + set on the floor", "better", "base", _PHYSICS),
            ("IK without TTA", "base + IK", "", "", ()),
            ("TTA, set on the floor", "base + TTA + set on the floor", "better", "base + TTA", _PHYSICS),
            (
                "TTA, IK, set on the floor",
                "base + TTA + IK + set on the floor",
                "better",
                "base + TTA + IK",
                _PHYSICS,
            ),
            (
                "TTA, `poise track` (no help, not trained on it)",
                "base + TTA + universal policy with lookahead",
                "better",
                "base",
                (*_PHYSICS, "-l2p"),
            ),
            (
                "TTA, `poise track` trained on it (help to none)",
                "from the tracker",
                "better",
                "base",
                (*_PHYSICS, "-l2p"),
            ),
        )
        for n in _LENGTHS
    )
    + tuple(
        Claim(
            f"{title}, 30 frames",
            _stage(f"full, {title}", 30),
            "worse",
            _stage("full", 30),
            "all stages",
            judged=(*_PHYSICS, "l2p"),
        )
        for title in ("without adaptation", "without inverse kinematics", "without the floor")
    ),
    _SKELETON,
    printed="no row",
)
_S2H_2 = PaperTable(
    _GAPS[:4],
    tuple(
        Claim(
            f"{name}, {n} frames",
            _stage(ours, n),
            says,
            _stage("base", n) if says else "",
            "the baseline" if says else "",
            f"Skeleton2Humanoid, Table 2, {n} frames; {name}",
        )
        for name, ours, says in (("baseline", "base", ""), ("baseline w/ TTA", "base + TTA", "better"))
        for n in _LENGTHS
    ),
    f"{_PAPERS} skeleton-stages",
)
_TAKES = "inbetween-complete:Bandai, other takes of what was learned; {}"
_ACCURACY = tuple(
    Measure(f"{title} at {n}", f"{metric}_{n}", "3", -1)
    for title, metric in (("L2Q", "l2q"), ("L2P", "l2p"))
    for n in _LENGTHS
)
_RTN, _ADAPTED = _TAKES.format("rtn trained on it"), _TAKES.format("rtn trained on it and adapted")
_OURS_IN_PLACE = "transformer trained on it"
_S2H_3 = PaperTable(
    _ACCURACY,
    (
        Claim(
            "Zero-Vel",
            _TAKES.format("nothing (standing still)"),
            paper="Skeleton2Humanoid, Table 3; Zero-Vel",
        ),
        Claim("Interp", _TAKES.format("interpolation"), paper="Skeleton2Humanoid, Table 3; Interp"),
        Claim("Kaufmann et al., not built", run="", paper="Skeleton2Humanoid, Table 3; Kaufmann et al."),
        Claim("Duan et al., not built", run="", paper="Skeleton2Humanoid, Table 3; Duan et al."),
        Claim(
            "baseline, Harvey et al.'s own",
            run="",
            paper="Skeleton2Humanoid, Table 3; baseline (Harvey et al.)",
        ),
        Claim(
            "baseline, self-implementation",
            _RTN,
            "better",
            _TAKES.format("interpolation"),
            "Interp",
            "LAFAN1; RTN (Harvey et al.)",
        ),
        Claim(
            "baseline w/ ablation (no smooth loss)",
            says="better",
            beside="the baseline",
            run="",
            paper="Skeleton2Humanoid, Table 3; baseline w/ ablation",
        ),
        Claim(
            "baseline w/ TTA",
            _ADAPTED,
            "better",
            _RTN,
            "the baseline",
            "LAFAN1; Skeleton2Humanoid, network and adaptation",
        ),
        Claim(
            "the transformer (ours alone)",
            _TAKES.format(_OURS_IN_PLACE),
            "better",
            _RTN,
            "the baseline",
            printed="no row",
        ),
        Claim(
            "the transformer w/ TTA (ours alone)",
            _TAKES.format(f"{_OURS_IN_PLACE} and adapted"),
            "better",
            _TAKES.format(_OURS_IN_PLACE),
            "the transformer",
            printed="no row",
        ),
    ),
    "python -m benchmarks inbetween-complete --only bandai",
)
_IMITATED_GAPS = (
    Measure("L2P", "l2p", "3", -1),
    Measure("MPJPE, mm", "mpjpe_mm", "2", -1),
    Measure("help, N", "force_mean_n", "0", -1),
)


def _corrections() -> tuple[Claim, ...]:
    whole, both = _stage("full", 30), ("l2p", "mpjpe_mm")
    return (
        *(
            Claim(
                name,
                _stage(variant, 30),
                "worse",
                whole,
                "CRP",
                f"Skeleton2Humanoid, Table 4; {name}",
                both,
            )
            for name, variant in (
                ("UHC", "uhc"),
                ("CRP w/o TwoFrameFeats", "one frame"),
                ("CRP w/o CurForce", "no curriculum"),
            )
        ),
        Claim("CRP", whole, paper="Skeleton2Humanoid, Table 4; CRP"),
        Claim("CRP to no force (ours alone)", _stage("full to zero", 30), printed="no row"),
        Claim(
            "from the tracker to no force (ours alone)",
            _stage("from the tracker", 30),
            "better",
            whole,
            "CRP",
            judged=both,
            printed="no row",
        ),
    )


_S2H_4 = PaperTable(_IMITATED_GAPS, _corrections(), _SKELETON, "Skeleton2Humanoid, Table 4; any policy")
_S2H_IK = PaperTable(
    (Measure("MPJPE, mm", "mm", "2", -1), Measure("ms a sequence", "cpu_ms", "0", -1)),
    (
        Claim(
            "analytic IK",
            "papers:Skeleton2Humanoid, places alone, noise 0 mm; analytic IK",
            "reaches",
            paper="Skeleton2Humanoid, Sec. 4.2.2; analytic IK",
        ),
        Claim(
            "the fit of keypoints (ours alone)",
            "papers:Skeleton2Humanoid, places alone, noise 0 mm; the fit of keypoints",
            printed="no row",
        ),
    ),
    _SKELETON,
)
_WAYS = "papers:Skeleton2Humanoid, ways between clips; "
_S2H_WAYS = PaperTable(
    (
        share("done", "done"),
        Measure("s", "way_s", "1", -1),
        Measure("jerk, m/s³", "way_jerk_m_per_s3", "0", -1),
    ),
    (
        Claim(
            "by the network (ours alone)", f"{_WAYS}the network", "better", f"{_WAYS}planned", "planned"
        ),
        Claim("planned (ours alone)", f"{_WAYS}planned"),
    ),
    f"{_PAPERS} skeleton-ways",
    printed="no row",
)
_DROPOUT = "papers:Skeleton2Humanoid, a stream that drops out for"
_SHIPS = "as it ships"
_S2H_DROPOUT = PaperTable(
    (
        Measure("error, mm", "gap_error_mm", "1", -1),
        Measure("slide, mm/s", "gap_slide_mm_per_s", "0", -1),
        Measure("s to adapt", "adapted_s", "1"),
    ),
    tuple(
        Claim(
            f"{n} frames; {name} (ours alone)",
            f"{_DROPOUT} {n} frames; {name}",
            "" if name == _SHIPS else "better",
            "" if name == _SHIPS else f"{_DROPOUT} {n} frames; {_SHIPS}",
            "" if name == _SHIPS else _SHIPS,
            judged=("gap_error_mm", "gap_slide_mm_per_s"),
        )
        for n in (5, 15)
        for name in (_SHIPS, "adapted to the gap", "adapted to the last second")
    ),
    f"{_PAPERS} skeleton-dropout",
    printed="no row",
)
_ITERATIONS = ("baseline", *(f"iteration {k}" for k in range(1, 8)))
_ADAPTATION = "papers:Skeleton2Humanoid, adaptation; "
_ITERATED = f"{_PAPERS} skeleton-iterations"
_S2H_5 = PaperTable(
    (*_ACCURACY[3:], *_ACCURACY[:3]),
    tuple(
        Claim(
            name,
            _ADAPTATION + name,
            says,
            _ADAPTATION + "baseline" if says else "",
            "the baseline" if says else "",
            f"Skeleton2Humanoid, Table 5; {name}",
        )
        for name, says in zip(_ITERATIONS, ("", *("better",) * 7), strict=True)
    ),
    _ITERATED,
)
_S2H_6 = PaperTable(
    tuple(Measure(f"ms at {n}", f"ms_{n}", "1", -1) for n in _LENGTHS),
    tuple(
        Claim(name, _ADAPTATION + name, paper=f"Skeleton2Humanoid, Table 6; {name}")
        for name in _ITERATIONS
    ),
    _ITERATED,
)

# --- Deep Compliant Control -------------------------------------------------------------------------

_LAG = "stiffness 500, lag 0.5 s"
_LEVELS = ("0.04", "0.08", "0.12", "0.16", "0.2")
_SCENES = "python -m benchmarks scenes --only"
#: Measures what was learned on top of the policy.
_LEARNED = f"{_SCENES} learned"
_HELD = "scenes:standing, hands, "
_STIFF = PaperTable(
    (Measure("stiffness, N/m", "stiffness_n_per_m", "0", -1),),
    (
        Claim("no compliance", f"{_HELD}law off"),
        *(
            Claim(
                f"level {level}",
                f"{_HELD}level {level}",
                "better",
                f"{_HELD}law off",
                "no compliance",
                printed="(1 - level) of none",
                words="softer than",
            )
            for level in _LEVELS
        ),
        *(
            Claim(f"commanded {k} N/m (ours alone)", f"{_HELD}commanded {k} N/m", printed="no row")
            for k in (20, 160, 1000)
        ),
    ),
    f"{_SCENES} stiffness",
)


def _throws(law: str, level: str) -> str:
    return f"scenes:throws, {law}, {level}"


def _by(scene: str) -> str:
    """Words of rows with what a run learned of a scene."""
    return f"learned by {scene}"


_BLOWS = (
    Measure("greatest force over level 0's", "peak_ratio", "3", -1),
    Measure("impulse", "impulse_ratio", "3", -1),
    Measure("torque", "torque_ratio", "3", -1),
)
_FIGURE_4 = PaperTable(
    _BLOWS,
    (
        *(
            Claim(
                f"level {a}, {rate} Hz",
                _throws(f"eq8, {rate} Hz", f"level {a}"),
                "better",
                _throws(f"eq8, {rate} Hz", "level 0"),
                "level 0",
            )
            for rate in (60, 600)
            for a in _LEVELS
        ),
        *(
            Claim(
                f"level {a}, 600 Hz, trained for the scene",
                _throws(f"eq8, 600 Hz, {_by('throws')}", f"level {a}"),
                "better",
                _throws(f"eq8, 600 Hz, {_by('throws')}", "level 0"),
                "level 0",
                run=_LEARNED,
            )
            for a in _LEVELS
        ),
        *(
            Claim(
                f"commanded {k} N/m, 60 Hz (ours alone)",
                _throws("stiffness, 60 Hz", f"{k} N/m"),
                "better",
                _throws("stiffness, 60 Hz", "4000 N/m"),
                "4000 N/m",
                printed="no row",
            )
            for k in (1000, 200, 50)
        ),
    ),
    f"{_SCENES} throws",
    "Deep Compliant Control, Sec. 5.1; any skill",
    "a bar of less than 1",
)
_SLOPES = PaperTable(
    (
        Measure("greatest force, slope over levels", "peak_slope", "3", -1),
        Measure("impulse", "impulse_slope", "3", -1),
        Measure("torque", "torque_slope", "3", -1),
    ),
    (
        *(
            Claim(
                f"throws, {r} Hz{', trained for the scene' if by else ''}",
                _throws(f"eq8, {r} Hz{by}", "all levels"),
                "better",
                beside="none",
                words="a slope below",
                run=_LEARNED if by else f"{_SCENES} throws",
            )
            for r, by in ((60, ""), (600, ""), (600, f", {_by('throws')}"))
        ),
    ),
    f"{_SCENES} throws",
    printed="falls",
)
_RANGES = PaperTable(
    (Measure("frames with a hinge outside its range", "outside", "%", -1),),
    (
        *(Claim(f"level {a}", f"scenes:throws, no range held, level {a}") for a in (0.04, 0.12, 0.2)),
        *(
            Claim(
                f"level {a}",
                f"scenes:throws, no range held, level {a}",
                "worse",
                "scenes:throws, no range held, level 0.2",
                "level 0.2",
            )
            for a in (0.3, 0.4)
        ),
    ),
    f"{_SCENES} ranges",
    printed="in words",
)


def _hands() -> tuple[Claim, ...]:
    out = list[Claim]()
    for how, title in (
        ("running", "running"),
        ("two people running", "two people running, both giving way"),
        ("two people walking", "two people walking, both giving way (ours alone)"),
        ("walking", "walking (ours alone)"),
        ("standing", "standing (ours alone)"),
    ):
        scene = f"scenes:hand in hand, {how}, "
        for way in ("level 0.16", "level 0.2", _LAG):
            out.append(
                Claim(f"{title}, {way}", f"{scene}{way}", "better", f"{scene}without", "the stiff twin")
            )
        out.append(Claim(f"{title}, nobody touches", f"{scene}nobody touches", printed="no row"))
    walking, by = "scenes:hand in hand, walking, ", f"{_by('hands')}, "
    for level in ("level 0.16", "level 0.2"):
        ours, than = f"{walking}{by}{level}", f"{walking}{by}without"
        name = f"walking (ours alone), {level}, trained for the scene"
        out.append(Claim(name, ours, "better", than, "the stiff twin, trained, too", run=_LEARNED))
    return tuple(out)


_HANDS = PaperTable(
    (
        Measure("steps", "steps", "1"),
        Measure("force, N", "force_mean_n", "0", -1),
        Measure("dragged off, m", "off_m", "3", -1),
        share("lost", "lost", -1),
    ),
    _hands(),
    f"{_SCENES} hands",
)
_FIGHT = "scenes:chicken, heavy and light, "


_FOUGHT = f"heavy and light, {_by('chicken')}"


def _light(name: str, than: str, beside: str, metric: str) -> Claim:
    """How far the light player is pushed."""
    ours = f"{_FIGHT}level 0.16"
    return Claim(
        name,
        ours,
        "better",
        than,
        beside,
        metric="rival_pushed_mm",
        than_metric=metric,
        words="farther than",
    )


_CHICKEN = PaperTable(
    (Measure("pushed off, mm", "pushed_mm", "0"),),
    (
        _light("the light one", f"{_FIGHT}level 0.16", "the heavy one", "pushed_mm"),
        _light(
            "the light one", f"{_FIGHT}without", "the light one without compliance", "rival_pushed_mm"
        ),
        _light(
            "the light one",
            "scenes:chicken, 60 kg each, level 0.16",
            "one of equal masses",
            "rival_pushed_mm",
        ),
        _light("the light one", f"{_FIGHT}nobody touches", "one whom nobody touches", "pushed_mm"),
        *(
            Claim(
                f"{who} against a bag",
                f"scenes:chicken, {who} against a bag of {kg} kg, level 0.16",
                "better",
                f"scenes:chicken, {who} against a bag of {kg} kg, nobody touches",
                "where nobody touches",
                words="farther than",
            )
            for who, kg in (("heavy", 36), ("light", 85))
        ),
        *(
            Claim(
                "the light one, both trained",
                f"{_FIGHT}{_by('chicken')}, level 0.16",
                "better",
                f"scenes:chicken, {than}",
                beside,
                metric="rival_pushed_mm",
                than_metric=metric,
                words="farther than",
                run=_LEARNED,
            )
            for than, beside, metric in (
                (f"{_FOUGHT}, level 0.16", "the heavy one", "pushed_mm"),
                (f"{_FOUGHT}, without", "the light one without compliance", "rival_pushed_mm"),
                (
                    f"60 kg each, {_by('chicken')}, level 0.16",
                    "one of equal masses, trained",
                    "rival_pushed_mm",
                ),
                (f"{_FOUGHT}, nobody touches", "one whom nobody touches, trained", "pushed_mm"),
            )
        ),
    ),
    f"{_SCENES} chicken",
)
_HOPS = PaperTable(
    (
        Measure("on one leg, s", "one_leg_s", "1"),
        share("to the end", "one_leg"),
        share("lost", "lost", -1),
    ),
    (
        Claim("level 0.16", "scenes:chicken, hopping alone for 17 s, level 0.16"),
        Claim(
            "level 0.16, trained for the scene",
            f"scenes:chicken, hopping alone for 17 s, {_by('hops')}, level 0.16",
            "better",
            "scenes:chicken, hopping alone for 17 s, level 0.16",
            "not trained",
            run=_LEARNED,
        ),
    ),
    f"{_SCENES} chicken",
    printed="a motion of 17.6 s",
)
_FORCES = PaperTable(
    (
        Measure("greatest force of an episode, N", "force_peak_n", "0", -1),
        Measure("mean force, N", "force_mean_n", "0", -1),
        share("lost", "lost", -1),
    ),
    tuple(
        Claim(
            f"heavy and light, {way}",
            f"{_FIGHT}{way}",
            "" if way == "without" else "better",
            f"{_FIGHT}without",
            "without compliance",
            judged=("force_peak_n", "force_mean_n"),
        )
        for way in ("without", "level 0.16", _LAG)
    ),
    f"{_SCENES} chicken",
)
_FIGURE_5 = PaperTable(
    (
        Measure("lowest foot, m", "foot_low_m", "3"),
        Measure("energy, J", "energy_j", "1", -1),
        share("lost", "lost", -1),
    ),
    (
        Claim("without compliance", "scenes:trampoline, without"),
        *(
            Claim(
                f"level {a}",
                f"scenes:trampoline, level {a}",
                "better",
                "scenes:trampoline, without",
                "without compliance",
                judged=("foot_low_m", "energy_j"),
            )
            for a in ("0.04", "0.16")
        ),
        *(
            Claim(
                f"level {a}, trained for the scene",
                f"scenes:trampoline, {_by('trampoline')}, level {a}",
                "better",
                f"scenes:trampoline, {_by('trampoline')}, without",
                "without compliance",
                judged=("foot_low_m", "energy_j"),
                run=_LEARNED,
            )
            for a in ("0.04", "0.16")
        ),
    ),
    f"{_SCENES} trampoline",
    "Deep Compliant Control, Sec. 5.1; any skill",
    "a curve",
)


def _doors() -> tuple[Claim, ...]:
    out = list[Claim]()
    for how in ("level 0.16", _LAG, f"{_by('door')}, as learned"):
        run = _LEARNED if how.startswith("learned") else f"{_SCENES} door"
        for width in ("1", "1.35", "1.7"):
            door = f"scenes:door {width} m, " + ("" if width == "1" else "motion for 1 m, ")
            across = ("across_n",)
            out.append(
                Claim(
                    f"{width} m wide, {how}",
                    f"{door}{how}",
                    "better",
                    f"{door}without",
                    "without compliance",
                    judged=across,
                    run=run,
                )
            )
            if width != "1":
                first = f"scenes:door 1 m, {how}"
                wide = f"{width} m wide, {how}"
                like = Claim(wide, f"{door}{how}", "alike", first, "1 m wide", judged=across, run=run)
                out.append(like)
    return tuple(out)


_FIGURE_6 = PaperTable(
    (
        Measure("orthogonal force, N", "across_n", "1", -1),
        Measure("parallel force, N", "along_n", "1", -1),
    ),
    _doors(),
    f"{_SCENES} door",
    printed="a bar",
)
_OPENED = PaperTable(
    (Measure("door opened, rad", "angle_rad", "2"), share("opened", "opened")),
    tuple(
        Claim(
            f"{width} m wide, the motion for 1 m, {how}",
            f"scenes:door {width} m, " + ("" if width == "1" else "motion for 1 m, ") + how,
            "reaches",
            paper="Deep Compliant Control, Sec. 5.4; a door of any width",
            judged=("angle_rad",),
            run=_LEARNED if how.startswith("learned") else f"{_SCENES} door",
        )
        for how in ("without", "level 0.16", _LAG, f"{_by('door')}, as learned")
        for width in ("1", "1.35", "1.7")
    ),
    f"{_SCENES} door",
)
_BALL = PaperTable(
    (Measure("stays, s", "stays_s", "1"), share("lost", "lost", -1)),
    tuple(
        Claim(
            f"{name}, learned",
            f"scenes:{scene}, learned",
            "better",
            f"scenes:{scene}, without",
            "nothing learned",
            judged=("stays_s",),
        )
        for name, scene in (
            ("a rod of 1 m", "ball"),
            *((f"a rod of {m:g} m (ours alone)", f"ball, rod of {m:g} m") for m in (0.8, 0.9, 1.1, 1.2)),
            ("pushed with 50 N (ours alone)", "ball, pushed with 50 N"),
            ("pushed with 50 N, another seed (ours alone)", "ball, pushed with 50 N, another seed"),
            ("pushed with 100 N (ours alone)", "ball, pushed with 100 N"),
        )
    ),
    f"{_SCENES} ball",
)
_TARGETS = "nothing (targets)"


def _planned(kind: str, how: str) -> str:
    return f"papers:Deep Compliant Control, controller; planner in place, {kind}, {how}"


_CONTROLLER = PaperTable(
    (
        Measure("falls a minute", "falls_a_minute", "1", -1),
        Measure("off the root, m", "root_m", "2", -1),
        Measure("off the nearest pose, mm", "nearest_pose_mm", "0", -1),
        Measure("transitions a minute", "transitions_a_minute", "1"),
        Measure("share at the goal's clip", "as_the_goal", "%"),
    ),
    (
        *(
            Claim(
                f"by the adversarial network, pushes x {k}",
                f"papers:Deep Compliant Control, controller; adversarial, pushes x {k}",
                "better",
                f"papers:Deep Compliant Control, controller; nothing (targets), pushes x {k}",
                "nothing learned",
                judged=("falls_a_minute",),
            )
            for k in (0, 1, 2)
        ),
        *(
            Claim(
                f"standing, walking, turning, running, {kind} targets",
                _planned(kind, "from clip to clip"),
                "better",
                _planned(_TARGETS, "from clip to clip"),
                "nothing learned",
                judged=("falls_a_minute", "as_the_goal"),
            )
            for kind in ("absolute", "additive")
        ),
    ),
    f"{_PAPERS} compliant",
    "Deep Compliant Control, Sec. 5.1; any skill",
)
_PULLED, _CALM = "a hand pulled at 0.5 m/s", "nobody pulls"
_PLANNER = PaperTable(
    (
        Measure("steps", "steps", "1"),
        Measure("along the pull, m", "along_m", "2"),
        share("lost", "lost", -1),
    ),
    tuple(
        claim
        for kind in ("absolute", "additive")
        for claim in (
            Claim(
                f"{_PULLED}, {kind} targets",
                _planned(kind, _PULLED),
                "better",
                _planned(_TARGETS, _PULLED),
                "nothing learned",
                judged=("steps", "lost"),
            ),
            Claim(
                f"{_PULLED}, {kind} targets",
                _planned(kind, _PULLED),
                "better",
                _planned(kind, _CALM),
                "where nobody pulls",
                judged=("steps",),
            ),
            Claim(
                f"{_CALM}, {kind} targets (ours alone)",
                _planned(kind, _CALM),
                "better",
                _planned(_TARGETS, _CALM),
                "nothing learned",
                judged=("lost",),
                printed="no row",
            ),
            Claim(
                f"a backflip, {kind} targets",
                f"papers:Deep Compliant Control, controller; backflip, {kind}",
                "better",
                f"papers:Deep Compliant Control, controller; backflip, {_TARGETS}",
                "nothing learned",
                judged=("lost",),
            ),
        )
    ),
    f"{_PAPERS} compliant",
    "Deep Compliant Control, Sec. 5.1; any skill",
)

# --- Perpetual Humanoid Control ---------------------------------------------------------------------

_ERRORS = (
    share("Succ", "done"),
    Measure("g-MPJPE, mm", "g_mpjpe_mm", "1", -1),
    Measure("MPJPE, mm", "mpjpe_mm", "1", -1),
    Measure("E_acc, mm/frame²", "acc_mm_per_frame2", "1", -1),
    Measure("E_vel, mm/frame", "vel_mm_per_frame", "1", -1),
)
_DONE = ("done",)
_LADDER = "papers:Perpetual Humanoid Control, Table 3; "
_PERPETUAL = f"{_PAPERS} perpetual"


def _imitations() -> tuple[Claim, ...]:
    out = list[Claim]()
    for paper, title, ours, part in (
        (
            "AMASS-Train",
            "our recordings, learned",
            "recordings and their retimed copies, learned",
            "library",
        ),
        ("AMASS-Test", "Bandai's test", "Bandai, four styles never looked at (test)", "bandai-test"),
        ("H36M-Motion", "Bandai, validation", "Bandai, never learned (validation)", "bandai"),
    ):
        uhc = paper == "AMASS-Train"
        for name, row in (("UHC, RFC", "uhc-helped"), ("UHC", "uhc")):
            published = "UHC with residual force" if name != "UHC" else "UHC"
            out.append(
                Claim(
                    f"{paper}, {name}" + (", ours on a dozen clips" if uhc else ""),
                    f"{_LADDER}{row}" if uhc else "",
                    "worse",
                    f"{_LADDER}relaxed",
                    "Ours",
                    f"{published}, {paper}",
                    _DONE,
                    run=_PERPETUAL if uhc else "",
                )
            )
        alone, keys = (f"track:{ours}; policy{of} alone" for of in ("", " of keypoints"))
        command = f"python -m benchmarks track --only '{part}, {{}}'"
        out += [
            Claim(
                f"{paper}, Ours: {title}",
                alone,
                "reaches",
                paper=f"PHC, {paper}",
                judged=_DONE,
                run=command.format("policy"),
            ),
            Claim(
                f"{paper}, Ours-kp: {title}",
                keys,
                "reaches",
                paper=f"PHC of keypoints, {paper}",
                judged=_DONE,
                run=command.format("keypoints"),
            ),
            Claim(
                f"{paper}, Ours-kp: {title}",
                keys,
                "alike",
                alone,
                "Ours",
                f"PHC of keypoints, {paper}",
                _DONE,
                run=command.format("keypoints"),
            ),
        ]
    held = "track:held-out CMU subjects 05, 11, 14; policy alone"
    out += [
        Claim("held-out CMU subjects (ours alone)", held, printed="no row"),
        Claim(
            "recordings without copies, learned (ours alone)",
            "track:recordings, learned; policy alone",
            printed="no row",
        ),
        Claim(
            "Bandai, nothing (action 0)",
            "track:Bandai, never learned (validation); nothing (action 0)",
            printed="no row",
        ),
    ]
    return tuple(out)


_PHC_1 = PaperTable(_ERRORS, _imitations(), "python -m benchmarks track")
_VIDEO = "H36M-Test-Video; "
_ESTIMATED = "track:files of real pose estimators; policy alone"
_PHC_2 = PaperTable(
    _ERRORS[:3],
    (
        Claim(
            "UHC, RFC, HybrIK + MeTRAbs (root)",
            says="worse",
            beside="Ours",
            run="",
            paper=f"{_VIDEO}UHC with residual force, rotations",
        ),
        Claim(
            "UHC, HybrIK + MeTRAbs (root)",
            says="worse",
            beside="Ours",
            run="",
            paper=f"{_VIDEO}UHC, rotations",
        ),
        Claim(
            "Ours, HybrIK + MeTRAbs (root): files of estimators",
            _ESTIMATED,
            "reaches",
            paper=f"{_VIDEO}PHC, rotations",
            judged=_DONE,
        ),
        Claim(
            "Ours-kp, HybrIK + MeTRAbs (root)",
            says="reaches",
            run="",
            paper=f"{_VIDEO}PHC of keypoints, rotations",
        ),
        Claim(
            "Ours-kp, MeTRAbs (all keypoints)",
            says="reaches",
            run="",
            paper=f"{_VIDEO}PHC of keypoints, all keypoints",
        ),
        *(
            Claim(
                f"an estimator's errors added, strength {k}{more} (ours alone)",
                f"track:Bandai, never learned (validation), noise {rung}; {how}",
                printed="no row",
                run=f"python -m benchmarks track --only 'noise{more}'",
            )
            for more, how in (("", "policy alone"), (", lookahead", "with lookahead"))
            for k, rung in (
                (0, "clean"),
                (0.25, "all x0.25"),
                (0.5, "all x0.5"),
                (1, "all x1"),
                (2, "all x2"),
            )
        ),
    ),
    "python -m benchmarks track --only estimators",
)
_PHC_3 = PaperTable(
    _ERRORS[:3],
    (
        *(
            Claim(
                f"R{k}: {name}",
                f"{_LADDER}{ours}",
                says,
                f"{_LADDER}{than}" if than else "",
                beside,
                f"Perpetual Humanoid Control, Table 3; R{k}",
                _DONE,
            )
            for k, (name, ours, says, than, beside) in enumerate(
                (
                    ("none", "plain", "", "", ""),
                    ("RET", "relaxed", "better", "plain", "R1"),
                    ("RET, MCP", "multiplicative", "better", "relaxed", "R2"),
                    ("RET, MCP, PNN", "progressive", "better", "multiplicative", "R3"),
                    ("RET, MCP, PNN, Fail-Recover", "recovery", "alike", "progressive", "R4"),
                    (
                        "the same by keypoints",
                        "absolute-keypoints",
                        "alike",
                        "absolute-rotations",
                        "rotations",
                    ),
                ),
                1,
            )
        ),
        *(
            Claim(
                f"{name} ({where})", f"{_LADDER}{ours}", says, f"{_LADDER}{than}", beside, judged=_DONE
            )
            for name, where, ours, says, than, beside in (
                ("the energy penalty left out", "Sec. 3.1", "no-energy", "worse", "relaxed", "R2"),
                ("the motion prior", "Sec. 3.1", "style", "better", "relaxed", "R2"),
                ("a mixture of means", "supplement", "means", "worse", "progressive", "R4"),
                ("one primitive", "supplement", "primitives-1", "worse", "progressive", "R4"),
                ("four primitives", "supplement", "primitives-4", "better", "progressive", "R4"),
            )
        ),
        Claim("nothing (action 0)", f"{_LADDER}nothing (action 0)", printed="no row"),
    ),
    _PERPETUAL,
)
_PHC_4 = PaperTable(
    (share("Succ-5s", "back_in_5_s"), share("Succ-10s", "back_in_10_s")),
    tuple(
        Claim(f"{title}, {row}", f"recover:{kind}; policy{ours}", "reaches", paper=f"{kind}; PHC{ours}")
        for row, ours in (("Ours", ""), ("Ours-kp", " of keypoints"))
        for kind, title in (
            ("fallen", "Fallen-State"),
            ("far", "Far-State"),
            ("fallen and far", "Fallen + Far-State"),
        )
    ),
    "python -m benchmarks recover",
)
_PHC_LIVE = PaperTable(
    (
        Measure("Hz", "hz", "1"),
        Measure("least Hz", "hz_least", "1"),
        Measure("latency p99, ms", "latency_p99_ms", "0", -1),
    ),
    (
        *(
            Claim(
                f"a live avatar (4d): {title}",
                f"live:{subject}",
                "reaches",
                paper="Perpetual Humanoid Control, Sec. 4; the composed policy",
                judged=("hz",),
            )
            for title, subject in (
                ("four people, free cores", "four people, otherwise free cores"),
                ("four people, busy cores", "four people, busy cores"),
            )
        ),
        Claim("poses of a camera (4d)", run=""),
        Claim("clips of a language model in a row (4c)", run=""),
    ),
    "python -m benchmarks live --only endure",
)

PAPER_TABLES: dict[str, PaperTable] = {
    "rfc-figure-2": _FIGURE_2,
    "rfc-samples": _SOONER,
    "rfc-clips": _ALONE,
    "rfc-sitting": _SITTING,
    "rfc-times": _TIMES,
    "rfc-table-1": _TABLE_1,
    "rfc-table-2": _TABLE_2,
    "rfc-endless": _ENDLESS,
    "s2h-table-1": _S2H_1,
    "s2h-table-1-ours": _S2H_1_OURS,
    "s2h-table-2": _S2H_2,
    "s2h-table-3": _S2H_3,
    "s2h-ik": _S2H_IK,
    "s2h-ways": _S2H_WAYS,
    "s2h-dropout": _S2H_DROPOUT,
    "s2h-table-4": _S2H_4,
    "s2h-table-5": _S2H_5,
    "s2h-table-6": _S2H_6,
    "dcc-stiffness": _STIFF,
    "dcc-controller": _CONTROLLER,
    "dcc-planner": _PLANNER,
    "dcc-figure-4": _FIGURE_4,
    "dcc-slopes": _SLOPES,
    "dcc-ranges": _RANGES,
    "dcc-hands": _HANDS,
    "dcc-chicken": _CHICKEN,
    "dcc-hops": _HOPS,
    "dcc-chicken-forces": _FORCES,
    "dcc-figure-5": _FIGURE_5,
    "dcc-figure-6": _FIGURE_6,
    "dcc-door": _OPENED,
    "dcc-ball": _BALL,
    "phc-table-1": _PHC_1,
    "phc-table-2": _PHC_2,
    "phc-table-3": _PHC_3,
    "phc-table-4": _PHC_4,
    "phc-figure-4": _PHC_LIVE,
}
