"""The web console: what the rig sees and believes, and a hold to steer it by."""
