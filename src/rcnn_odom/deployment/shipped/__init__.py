"""Trained networks that ship with the project, each with its model card."""

# Models find them as well, and models know nothing of deployment.
from rcnn_odom.models.shipped_files import FOLDER as FOLDER
from rcnn_odom.models.shipped_files import find_file as find_file
from rcnn_odom.models.shipped_files import shipped_models as shipped_models
