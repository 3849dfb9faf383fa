#!/bin/sh
# First process of the guest: a throw-away overlay over the host's root, then systemd with nothing of the host enabled.
# From the kernel's command line: LAB, a directory with check.service; ENVIRONMENT, the virtual environment whose packages
# are used, which is shown at /opt/environment, outside every home directory; CHECKOUT, if any, a folder that is hidden.
export PATH=/usr/sbin:/usr/bin:/sbin:/bin
mount -t proc proc /proc
mount -t tmpfs -o mode=755 tmpfs /mnt
mkdir /mnt/upper /mnt/work /mnt/root
mount -t overlay overlay -o lowerdir=/,upperdir=/mnt/upper,workdir=/mnt/work /mnt/root || exit 1
root=/mnt/root
units=$root/etc/systemd/system
rm -rf "$units"/*.wants "$units"/*.requires
mkdir -p "$units/multi-user.target.wants" "$root/opt/environment"
for unit in getty.target getty@.service console-getty.service timers.target remote-fs.target dbus.socket dbus.service \
    systemd-timesyncd.service systemd-udev-trigger.service systemd-pstore.service \
    systemd-random-seed.service systemd-update-utmp.service systemd-logind.service e2scrub_reap.service \
    systemd-tmpfiles-setup.service systemd-tmpfiles-setup-dev.service systemd-binfmt.service systemd-sysusers.service; do
    ln -sf /dev/null "$units/$unit"
done
cp "$LAB/check.service" "$units/"
ln -s ../check.service "$units/multi-user.target.wants/"
ln -sf /lib/systemd/system/multi-user.target "$units/default.target"
: >"$root/etc/machine-id"
: >"$root/etc/fstab"
mount --bind "$root$ENVIRONMENT" "$root/opt/environment"
[ ! "${CHECKOUT-}" ] || mount -t tmpfs -o mode=755 tmpfs "$root$CHECKOUT"
umount /proc
cd $root && mount -n --move . /
# Shared, as on every machine that systemd boots without a chroot: else a service does not see its credentials.
exec chroot . /bin/sh -c 'mount -n --make-rshared /; exec /lib/systemd/systemd systemd.show_status=false'
