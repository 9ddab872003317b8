"""Recordings on disk and live, as scans."""
