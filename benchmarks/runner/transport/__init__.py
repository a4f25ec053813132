"""How fast messages travel: the runner beside bare Zenoh and dora-rs."""
