"""Many runs of the MuJoCo recipe as one study."""
