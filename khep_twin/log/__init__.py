"""Logs: every run as one self-contained MCAP file that rerun and Foxglove open by themselves."""
