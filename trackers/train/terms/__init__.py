"""Terms of a tracker's training: what is measured, rewarded, ended, randomised and shown to the critic."""
