"""Results and claims of the paper: Valente, Joly and de La Fortelle, *An LSTM Network for Real-Time Odometry
Estimation*, 2019."""

from dataclasses import dataclass


@dataclass(frozen=True)
class PaperColumn:
    """A column of the paper's table II.

    Attributes:
        name: heading of the column.
        drift: drifts of the two test sequences and their mean, as ratios.
        seconds: computing time of a frame without a GPU.
    """

    name: str
    drift: tuple[float, float, float]
    seconds: float


SEQUENCES = ("05", "07")
"""The paper's test sequences of KITTI's odometry benchmark."""

VARIANTS = {
    "cnn_reg": PaperColumn("CNN-Regression", (0.2888, 0.1281, 0.2084), 0.005),
    "cnn_cls": PaperColumn("CNN-Classification", (0.2764, 0.0756, 0.1760), 0.005),
    "rcnn_reg": PaperColumn("RCNN-Regression", (0.0293, 0.0218, 0.0255), 0.015),
    "rcnn_cls": PaperColumn("RCNN-Classification", (0.2488, 0.1251, 0.1869), 0.015),
}
"""Networks of the paper in table II, by the name of the variant in this project."""

COMPARED_METHODS = (
    PaperColumn("DeepVO (one camera)", (0.0262, 0.0391, 0.0326), 1.0),
    PaperColumn("3D LiDAR CNN (Velas et al.)", (0.0235, 0.0177, 0.0206), 0.7),
)
"""Methods in table II that the paper compares its networks with."""

NETWORK = {"model.kernel_size": 3, "model.pooling": "avg"}
"""Options of the convolutional network of the paper (table I, section III-B); table II has its results."""

TABLE_NOTE = (
    'The paper\'s figures are its table II, on real KITTI. Its caption calls them "RMSE translation drift" '
    "and times them without GPU acceleration; it adds that the 3D LiDAR CNN was trained on these sequences. "
    "Ours are means over segments, by the rule of KITTI's devkit."
)

CLAIMS = {
    "model.kernel_size": (
        "The paper chose kernels of size 3 after testing others such as 5 and 7 (section III-B); it gives "
        "no figures for them."
    ),
    "model.pooling": (
        "The paper tested max and average pooling and had better results with average pooling (section "
        "III-B); it gives no figures for them."
    ),
}
"""Claims of the paper in words, by the option that they are about."""

FRAME_ERRORS_NOTE = (
    "The paper (section IV) reports for its two real sequences a mean absolute error of 0.02 m and 0.05 "
    "degrees per frame, and errors up to 0.2 m and 0.4 degrees."
)
