"""What recipes share: checks of a configuration, the folder of a run, sweeps."""
