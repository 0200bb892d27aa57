"""The reach task: a figure of 25 joints whose feet step and whose hand reaches, within its reach and beyond, by any solver."""
