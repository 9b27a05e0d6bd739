"""Arrays, ranks, checks, versions of DOLFINx, times: what every room uses."""
