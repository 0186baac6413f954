"""The packages of the wheel; all else about it is in pyproject.toml."""

from setuptools import find_namespace_packages, setup

_CODE = ("estima", "estimators", "experiments", "sim")
_DATA = ("conf", "results.baselines")  # folders of the clone's top level

setup(
    packages=[
        *find_namespace_packages(include=[f"{name}*" for name in _CODE]),
        *(f"experiments.packaged.{name}" for name in _DATA),
    ]
)
