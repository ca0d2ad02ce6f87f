#!/bin/sh
# Create a site's certificate authority and the certificates of its router and of each role, with openssl.
set -eu
umask 077
usage() {
    cat <<'END'
usage: certificates.sh COMMAND FOLDER [...]     FOLDER contains ca.key: store it on one machine, preferably offline

  all FOLDER NAME...       all files of a new site; NAME: host names or addresses of the router
  ca FOLDER                only the authority (distribute ca.pem, never ca.key)
  router FOLDER NAME...    certificate of the router for these names, or its renewal
  role FOLDER ROLE...      certificates of roles (gateway worker viewer tools operator), or their renewal
  next-ca FOLDER           a new authority; ca.pem contains both until drop-ca
  drop-ca FOLDER           remove the old authority from ca.pem
  show FOLDER              subject and expiry of all certificates

DAYS=90: validity of certificates in days (CA_DAYS=3650: of the authority).
END
    exit 2
}
fail() { printf 'certificates: %s\n' "$*" >&2; exit 2; }

make_ca() {
    openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -sha256 -days "${CA_DAYS:-3650}" \
        -subj "/CN=ParaUAV site $(date -u +%Y-%m-%dT%H:%M:%SZ)" -keyout "$1/ca.key" -out "$1/ca.new" \
        -addext basicConstraints=critical,CA:true,pathlen:0 -addext keyUsage=critical,keyCertSign,cRLSign 2>/dev/null
}

sign() { # FOLDER NAME USAGE [SAN]: create a key and a certificate; install them when both exist
    folder=$1 name=$2
    [ -f "$folder/ca.key" ] || fail "found no $folder/ca.key, expected the site's authority; create it first: ca $folder"
    { printf 'basicConstraints=critical,CA:false\nkeyUsage=critical,digitalSignature\nextendedKeyUsage=%s\n' "$3"
      [ -z "${4:-}" ] || printf 'subjectAltName=%s\n' "$4"; } >"$folder/$name.ext"
    openssl req -new -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -subj "/CN=$name" \
        -keyout "$folder/$name.key.new" -out "$folder/$name.csr" 2>/dev/null
    openssl x509 -req -sha256 -days "${DAYS:-90}" -in "$folder/$name.csr" -CA "$folder/ca.signing" \
        -CAkey "$folder/ca.key" -set_serial "0x$(openssl rand -hex 16)" -extfile "$folder/$name.ext" \
        -out "$folder/$name.pem.new" 2>/dev/null || fail "openssl could not sign $name"
    mv "$folder/$name.key.new" "$folder/$name.key"
    mv "$folder/$name.pem.new" "$folder/$name.pem"
    chmod 644 "$folder/$name.pem"
    rm -f "$folder/$name.csr" "$folder/$name.ext"
}

names() { # host names and addresses of a router in the format of openssl
    out=
    for name; do
        case $name in
            *[!0-9.]*) case $name in *:*) kind=IP ;; *) kind=DNS ;; esac ;;
            *) kind=IP ;;
        esac
        out="$out${out:+,}$kind:$name"
    done
    printf %s "$out"
}

ca() {
    mkdir -p "$1"
    [ ! -e "$1/ca.key" ] || fail "found an existing $1/ca.key, expected none; use it, or create the next one: next-ca $1"
    make_ca "$1"
    mv "$1/ca.new" "$1/ca.signing"
    cp "$1/ca.signing" "$1/ca.pem"
    chmod 644 "$1/ca.pem"
}
router() {
    folder=$1; shift
    [ $# -gt 0 ] || usage
    sign "$folder" router serverAuth,clientAuth "$(names "$@")"
}
roles() {
    folder=$1; shift
    for role; do
        case $role in gateway|worker|viewer|tools|operator) sign "$folder" "$role" clientAuth ;;
        *) fail "found role '$role', expected gateway, worker, viewer, tools or operator; correct it" ;; esac
    done
}

[ $# -ge 2 ] || usage
command=$1 folder=$2; shift 2
case $command in
all) ca "$folder"; router "$folder" "$@"; roles "$folder" gateway worker viewer tools operator ;;
ca) ca "$folder" ;;
router) router "$folder" "$@" ;;
role) [ $# -gt 0 ] || usage; roles "$folder" "$@" ;;
next-ca)
    make_ca "$folder"
    mv "$folder/ca.new" "$folder/ca.signing"
    cat "$folder/ca.signing" "$folder/ca.pem" >"$folder/ca.both"
    mv "$folder/ca.both" "$folder/ca.pem"
    chmod 644 "$folder/ca.pem" ;;
drop-ca) cp "$folder/ca.signing" "$folder/ca.pem"; chmod 644 "$folder/ca.pem" ;;
show)
    for file in "$folder"/*.pem; do
        printf '%s: %s\n' "$(basename "$file")" "$(openssl x509 -in "$file" -noout -subject -enddate | tr '\n' ' ')"
    done ;;
*) usage ;;
esac
