"""The bottom of the contract: errors, histogram, size classes, versions. Imports nothing of ours."""
