/* A slave on libmodbus: "tcp" or a serial port as argument; unit 17; 100 holding and 100 input registers.
   Input register i holds i * i, except 0, which follows holding register 0 as an actuator follows its target. */
#include <arpa/inet.h>
#include <modbus/modbus.h>
#include <stdio.h>
#include <string.h>
int main(int argc, char **argv) {
    int is_tcp = argc > 1 && !strcmp(argv[1], "tcp"), s = -1, rc;
    modbus_t *ctx = is_tcp ? modbus_new_tcp("127.0.0.1", 0) : modbus_new_rtu(argv[1], 115200, 'N', 8, 1);
    modbus_mapping_t *map = modbus_mapping_new(0, 0, 100, 100);
    uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH];
    struct sockaddr_in at;
    socklen_t size = sizeof at;
    modbus_set_slave(ctx, 17);
    for (int i = 1; i < 100; i++) map->tab_input_registers[i] = i * i;
    if (is_tcp) s = modbus_tcp_listen(ctx, 1), getsockname(s, (struct sockaddr *)&at, &size);
    else if (modbus_connect(ctx)) return 1;
    printf("%d\n", is_tcp ? ntohs(at.sin_port) : 0), fflush(stdout);
    if (is_tcp) modbus_tcp_accept(ctx, &s);
    while ((rc = modbus_receive(ctx, query)) >= 0 || !is_tcp) {
        if (rc > 0) modbus_reply(ctx, query, rc, map);
        map->tab_input_registers[0] = map->tab_registers[0];
    }
    return 0;
}
