#!/bin/sh
# Pins the images of compose.yaml to the digests that their tags have now, in the file .env beside it:
#
#   deploy/container/pin.sh
#
# Later builds and starts use exactly these images, whatever the tags then mean. Run it again to update them. Needs Docker
# with buildx, and the registries.
set -eu
cd "$(dirname "$0")"
sed -n 's/.*\${\([A-Z]*_IMAGE\):-\([^}]*\)}.*/\1 \2/p' compose.yaml | while read -r name image; do
  digest=$(docker buildx imagetools inspect "$image" --format '{{.Manifest.Digest}}')
  touch .env
  sed -i "/^$name=/d" .env
  echo "$name=$image@$digest" | tee -a .env
done
