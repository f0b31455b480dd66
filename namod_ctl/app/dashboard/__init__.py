"""The page that the crew looks at: what a run or a campaign has on the disk, as it grows."""
