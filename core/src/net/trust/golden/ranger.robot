blastema robot key 1
robot   ranger
seed    CQkJCQkJCQkJCQkJCQkJCQkJCQkJCQkJCQkJCQkJCQk
blastema roster 1
robot   ranger
serial  1
node    base x25519 KEPG830BBNkZstJkZ-kJtqH0DN3DUdTR95oip8cv9mo ed25519 93soAy8KCBkVN6j8PcozjH_wbAY0zmLAyjv8RS523d8
node    arm x25519 7Oa-THoWtRxQPFdhJyY2JiU7AVMns3Yid5cGpaJEu38 ed25519 b1WN1BLd4EqwyICog3Wly_Celx3HXRKZFvdBzodu5uc
node    laptop x25519 H5aHCsGjORJpho0PYiajb5f5aoSNI3Wfw12g0bPP9HE ed25519 7pn0fPJQsvpD8rqkJmiDuiWxWyj6OhHmPK0MBnQzCVo role operator
node    tower x25519 mVbHc01a3E_U58DloZBGCGeRuSdi6k6Vi-ykYncwkFY ed25519 uq41Zh9rSwOVZfWiJL3Pm7eBYKX6TTEYLhjPT_Jp8Es
node    visitor x25519 kZrS1ZL_UFRu7RL9DO-c-SQMZwc-gE6JBDUzzFXqGmY ed25519 QHj1aaHez3Hy5VVwAyarSxyJcKIEziwIkZ-Q9pcmoYM role guest
policy
  only base laptop may lease on base/wheels
  only arm visitor may ask tell on arm/** by motion/*
end
signed  GQlaJq4k9hf7SwMlUR9oBWtjkJ5QHCOj8Mexey9BFYBOLT2puLenfhOfSt97AWFq_NhfS8I18pZR9bWuJN90CQ
