"""The version of the package, for rooms that write it down; `lagjax.__version__`."""

VERSION = "0.1.0"
